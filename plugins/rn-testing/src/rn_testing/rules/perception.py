"""Rules of perception sources: correct frames of the requested cameras. `perception_timing` has the
rest.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from rn_testing.attempts import attempt
from rn_testing.cases import PerceptionCase
from rn_testing.deadline import unbounded
from rn_testing.effects import check_memory
from rn_testing.fakes import MemoryTopics
from rn_testing.lifecycle import Lifecycle, started
from rn_testing.options import OPTIONS_READ, check_options_read
from rn_testing.rule import NotApplicable, Rule, require
from rn_testing.rules.clock import ros_clock
from rn_testing.snapshots import is_alike, snapshot
from roboneuron import (
    CameraCalibration,
    CameraProfile,
    Frame,
    NotReadyError,
    PerceptionSource,
)

SAME_IMAGE = 12.0
"""Tolerated mean difference of two images of the same scene, of 255, for lossy codecs."""
SHORT_READ_S = 0.05
"""Time-out of a read without input [s]."""
FRAMES = 6
"""Number of frames read in a row."""


@contextmanager
def opened(case: PerceptionCase) -> Iterator[tuple[PerceptionSource, MemoryTopics]]:
    topics = MemoryTopics(ros_clock)
    with started(
        case, attempt(case, lambda: case.prepare(topics)), lambda source: source.open()
    ) as source:
        yield source, topics


def feed(case: PerceptionCase, source: PerceptionSource, topics: MemoryTopics) -> None:
    if case.feed is not None:
        case.feed(unbounded(source), topics)


def read_frame(case: PerceptionCase, source: PerceptionSource, topics: MemoryTopics) -> Frame:
    feed(case, source, topics)
    return take_frame(case, source)


def take_frame(case: PerceptionCase, source: PerceptionSource) -> Frame:
    frame = attempt(case, lambda: source.read(case.timeout_s))
    require(isinstance(frame, Frame), f"read returned {type(frame).__name__}, expected a Frame")
    return frame


def _open_source(case: PerceptionCase, source: PerceptionSource) -> None:
    source.open()


def _use(case: PerceptionCase, source: PerceptionSource) -> object:
    """Read once; a time-out is allowed, because nothing is fed."""
    try:
        return source.read(SHORT_READ_S)
    except NotReadyError:
        return None


LIFECYCLE: Lifecycle[PerceptionCase, PerceptionSource] = Lifecycle(
    subject="perception",
    protocol=PerceptionSource,
    begin="open",
    start=_open_source,
    uses={"read": _use},
)
"""Start and use of a source."""


def _check_topics_untouched(case: PerceptionCase) -> None:
    topics = MemoryTopics()
    attempt(case, lambda: case.build(topics))
    require(
        not topics.used,
        f"the constructor uses the topics {', '.join(topics.used)}; use them in open()",
    )


def _check_frame(case: PerceptionCase) -> None:
    profiles = {c.name: c for c in case.profiles()}
    with opened(case) as (source, topics):
        frames = [read_frame(case, source, topics) for _ in range(FRAMES)]
    for frame in frames:
        require(
            frame.camera in profiles,
            f"a frame is of camera {frame.camera!r}, asked for: {', '.join(profiles)}",
        )
        profile = profiles[frame.camera]
        require(
            frame.frame_id == profile.frame_id,
            f"a frame has frame_id {frame.frame_id!r}, not {profile.frame_id!r}",
        )
        height, width = frame.image.shape[:2]
        size, wanted = f"{width}x{height}", f"{profile.width}x{profile.height}"
        require(size == wanted, f"a frame of {frame.camera!r} is {size}, the profile says {wanted}")


def _check_content(case: PerceptionCase) -> None:
    if case.expected is None:
        raise NotApplicable("the case does not say what the frame shows")
    wanted = case.expected()
    with opened(case) as (source, topics):
        image = read_frame(case, source, topics).image
    require(
        image.shape == wanted.shape, f"a frame is {image.shape}, the case expects {wanted.shape}"
    )
    error = float(np.abs(image.astype(float) - wanted).mean())
    swapped = float(np.abs(image[:, :, ::-1].astype(float) - wanted).mean())
    hint = "; red and blue are swapped" if swapped < error else ""
    require(
        error <= SAME_IMAGE,
        f"a frame differs from what the case expects by {error:.0f} of 255{hint}",
    )


def _check_calibration(case: PerceptionCase) -> None:
    def calibrated(camera: CameraProfile) -> CameraProfile:
        intrinsics = np.array(
            [[camera.width, 0, camera.width / 2], [0, camera.width, camera.height / 2], [0, 0, 1]]
        )
        made = CameraCalibration(intrinsics=intrinsics, mount="base", T_mount_camera=np.eye(4))
        return replace(camera, calibration=camera.calibration or made)

    profiles = {c.name: calibrated(c) for c in case.profiles()}
    with opened(replace(case, cameras=lambda: tuple(profiles.values()))) as (source, topics):
        frame = read_frame(case, source, topics)
    height, width = frame.image.shape[:2]
    wanted = profiles[frame.camera].calibration_at(width, height)
    who = f"a frame of {frame.camera!r}"
    require(
        wanted is None or frame.calibration is not None,
        f"{who} carries no calibration, its profile has one",
    )
    require(is_alike(frame.calibration, wanted), f"{who} has another calibration than its profile")


def _check_own_memory(case: PerceptionCase) -> None:
    with opened(case) as (source, topics):
        frames = [read_frame(case, source, topics) for _ in range(FRAMES)]
        kept = [snapshot(frame) for frame in frames]
        read_frame(case, source, topics)
    shared = any(np.shares_memory(a.image, b.image) for a, b in itertools.combinations(frames, 2))
    require(not shared, "two frames share the memory of their images")
    require([snapshot(frame) for frame in frames] == kept, "a frame that was read changes later")


def _check_options(case: PerceptionCase) -> None:
    def use(build: Callable[[], PerceptionSource]) -> None:
        with started(case, build, lambda source: source.open()) as source:
            read_frame(case, source, topics)

    topics = MemoryTopics()
    check_options_read(case, use, topics)


def _check_memory(case: PerceptionCase) -> None:
    topics = MemoryTopics(ros_clock, history=1)
    with started(
        case, attempt(case, lambda: case.prepare(topics)), lambda source: source.open()
    ) as source:
        check_memory(lambda: read_frame(case, source, topics), "read", count=FRAMES)


def _check_every_camera(case: PerceptionCase) -> None:
    if case.feed is not None:
        raise NotApplicable("the case feeds what is to be read")
    wanted = {camera.name for camera in case.profiles()}
    with opened(case) as (source, topics):
        seen = {read_frame(case, source, topics).camera for _ in range(4 * len(wanted))}
    require(wanted <= seen, f"no frame came from {', '.join(sorted(wanted - seen))}")


SOURCE = "roboneuron.contract.protocols.PerceptionSource"


def perception_rule(
    name: str, text: str, check: Callable[[PerceptionCase], None], source: str = f"{SOURCE}.read"
) -> Rule[PerceptionCase]:
    return Rule(id=f"perception/{name}", text=text, source=source, check=check)


RULES: tuple[Rule[PerceptionCase], ...] = (
    *LIFECYCLE.rules(without=("memory-bounded", "options-read")),
    perception_rule("options-read", OPTIONS_READ, _check_options, SOURCE),
    perception_rule(
        "constructor-leaves-topics",
        "The constructor neither subscribes nor advertises.",
        _check_topics_untouched,
        "roboneuron.contract.protocols.Topics",
    ),
    perception_rule(
        "frame-of-a-camera",
        "A frame comes from a requested camera, with that camera's frame_id and size.",
        _check_frame,
    ),
    perception_rule(
        "frame-expected",
        "A frame shows what the case expects, red first and upright.",
        _check_content,
    ),
    perception_rule(
        "calibration-kept",
        "A frame carries its camera's calibration; none when the profile has none for its size.",
        _check_calibration,
        "roboneuron.contract.observation.Frame",
    ),
    perception_rule(
        "frames-own-memory", "A frame is not changed by a later one.", _check_own_memory
    ),
    perception_rule("memory-bounded", "Memory does not grow with each `read`.", _check_memory),
    perception_rule(
        "every-camera-served",
        "Every requested camera delivers frames.",
        _check_every_camera,
    ),
)
"""Rules of perception sources."""

"""Rules of perception sources: true frames of the cameras asked for, stamped in ROS time, within
the time-out.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from rn_testing.attempts import attempt
from rn_testing.cases import PerceptionCase
from rn_testing.deadline import unbounded
from rn_testing.effects import check_memory, within
from rn_testing.fakes import MemoryTopics
from rn_testing.lifecycle import Lifecycle, started
from rn_testing.options import OPTIONS_READ, check_options_read
from rn_testing.rule import NotApplicable, Rule, Violation, require
from rn_testing.snapshots import is_alike, snapshot
from roboneuron import (
    CameraCalibration,
    CameraProfile,
    Frame,
    NotReadyError,
    PerceptionSource,
    RoboNeuronError,
)

LATE_S = 0.15
"""How much later than its time-out the quickest of five reads may return: a busy machine slows one,
not all.
"""
READS = 5
"""Reads of which the quickest is judged."""
SHORT_READ_S, LONG_READ_S = 0.05, 0.3
"""Time-outs of reads that nothing is fed for."""
CLOCK_OFFSET_NS = 7_200_000_000_000
"""How far the kit's ROS clock is from the wall clock, so that a stamp tells which one it was taken
from.
"""
FUTURE_S, PAST_S = 0.02, 2.0
"""How far a stamp may lie after the moment of its read, and before the source was opened."""
FEED_S = 0.3
"""How long a frame that was fed lies unread before its stamp is compared with the time it was fed
at.
"""
SAME_IMAGE = 12.0
"""Mean difference of two images that show the same, of 255: what a lossy codec leaves."""
FRAMES = 6
"""Frames that are read in a row."""
MANY_FRAMES, LOOK_S = 40, 1.0
"""Frames whose order is looked at; of slow cameras as many as come in that time, and FRAMES at
least.
"""
RATE_OPTIONS = ("rate_hz", "fps", "frame_rate_hz")
"""Options of sources that name the pace of each camera."""
TOO_FAST = 2.0
"""How many times the declared pace is no mistake of rounding; slower is what a busy machine does.
"""


def ros_clock() -> int:
    """ROS time of the kit [ns]: it runs as the wall clock does, at another hour."""
    return time.time_ns() + CLOCK_OFFSET_NS


@contextmanager
def _open(case: PerceptionCase) -> Iterator[tuple[PerceptionSource, MemoryTopics]]:
    topics = MemoryTopics(ros_clock)
    with started(
        case, attempt(case, lambda: case.prepare(topics)), lambda source: source.open()
    ) as source:
        yield source, topics


def _feed(case: PerceptionCase, source: PerceptionSource, topics: MemoryTopics) -> None:
    if case.feed is not None:
        case.feed(unbounded(source), topics)


def _read(case: PerceptionCase, source: PerceptionSource, topics: MemoryTopics) -> Frame:
    _feed(case, source, topics)
    return _take(case, source)


def _take(case: PerceptionCase, source: PerceptionSource) -> Frame:
    frame = attempt(case, lambda: source.read(case.timeout_s))
    require(isinstance(frame, Frame), f"read returned {type(frame).__name__}, expected a Frame")
    return frame


def _open_source(case: PerceptionCase, source: PerceptionSource) -> None:
    source.open()


def _use(case: PerceptionCase, source: PerceptionSource) -> object:
    """A read; the short time-out may pass, for nothing is fed."""
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
"""How a source is started and used."""


def _check_topics_untouched(case: PerceptionCase) -> None:
    topics = MemoryTopics()
    attempt(case, lambda: case.build(topics))
    require(
        not topics.used,
        f"the constructor uses the topics {', '.join(topics.used)}; that belongs into open()",
    )


def _check_frame(case: PerceptionCase) -> None:
    profiles = {c.name: c for c in case.profiles()}
    with _open(case) as (source, topics):
        frames = [_read(case, source, topics) for _ in range(FRAMES)]
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
    with _open(case) as (source, topics):
        image = _read(case, source, topics).image
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
    with _open(replace(case, cameras=lambda: tuple(profiles.values()))) as (source, topics):
        frame = _read(case, source, topics)
    height, width = frame.image.shape[:2]
    wanted = profiles[frame.camera].calibration_at(width, height)
    who = f"a frame of {frame.camera!r}"
    require(
        wanted is None or frame.calibration is not None,
        f"{who} carries no calibration, its profile has one",
    )
    require(is_alike(frame.calibration, wanted), f"{who} has not the calibration of its profile")


def _check_stamps(case: PerceptionCase) -> None:
    with _open(case) as (source, topics):
        opened_ns = ros_clock()
        for _ in range(FRAMES):
            stamp_ns = _read(case, source, topics).stamp_ns
            now_ns = ros_clock()
            early_s, late_s = (opened_ns - stamp_ns) / 1e9, (stamp_ns - now_ns) / 1e9
            require(
                late_s <= FUTURE_S, f"a frame is stamped {late_s:.3g} s in the future of ROS time"
            )
            require(
                early_s <= PAST_S,
                f"a frame is stamped {early_s:.3g} s before open() in ROS time, in nanoseconds",
            )


def _check_capture(case: PerceptionCase) -> None:
    if case.feed is None:
        raise NotApplicable("frames come by themselves")
    with _open(case) as (source, topics):
        _feed(case, source, topics)
        fed_ns = ros_clock()
        time.sleep(FEED_S)
        stamp_ns = _take(case, source).stamp_ns
    late_s = (stamp_ns - fed_ns) / 1e9
    require(
        late_s <= FEED_S / 2,
        f"a frame is stamped {late_s:.2f} s after it was captured; is that the time of read?",
    )


def _frames(
    case: PerceptionCase, source: PerceptionSource, topics: MemoryTopics
) -> Iterator[Frame]:
    until_s = time.monotonic() + LOOK_S
    for count in range(MANY_FRAMES):
        if count >= FRAMES and time.monotonic() > until_s:
            return
        yield _read(case, source, topics)


def _check_rate(case: PerceptionCase) -> None:
    if case.feed is not None:
        raise NotApplicable("the case feeds what is to be read")
    options = case.configuration()
    named = (getattr(options, name, None) for name in RATE_OPTIONS)
    rate_hz = case.rate_hz or next(
        (value for value in named if isinstance(value, (int, float)) and value > 0), None
    )
    if rate_hz is None:
        raise NotApplicable("neither the case nor an option says how many frames a second come")
    stamps: dict[str, list[int]] = {}
    with _open(case) as (source, topics):
        for frame in _frames(case, source, topics):
            stamps.setdefault(frame.camera, []).append(frame.stamp_ns)
    for camera, found in stamps.items():
        if len(found) >= 3:
            pace_hz = 1e9 / max(1.0, float(np.median(np.diff(found))))
            told = f"frames of {camera!r} come at {pace_hz:.3g} Hz, declared are {rate_hz:g} Hz"
            require(pace_hz <= TOO_FAST * rate_hz, told)


def _check_once(case: PerceptionCase) -> None:
    if case.feed is None:
        raise NotApplicable("frames come by themselves")
    with _open(case) as (source, topics):
        first = _read(case, source, topics)
        for _ in range(FRAMES):  # a source may have made more of what was fed, not without end
            try:
                again = source.read(SHORT_READ_S)
            except NotReadyError:
                return
            same = again.camera == first.camera and np.array_equal(again.image, first.image)
            require(not same, f"a frame of {first.camera!r} that was read is returned again")


def _check_order(case: PerceptionCase) -> None:
    newest: dict[str, int] = {}
    with _open(case) as (source, topics):
        for frame in _frames(case, source, topics):
            before = newest.get(frame.camera, 0)
            require(
                frame.stamp_ns > before,
                f"a frame of {frame.camera!r} is not stamped after the one read last",
            )
            newest[frame.camera] = frame.stamp_ns


def _check_own_memory(case: PerceptionCase) -> None:
    with _open(case) as (source, topics):
        frames = [_read(case, source, topics) for _ in range(FRAMES)]
        kept = [snapshot(frame) for frame in frames]
        _read(case, source, topics)
    shared = any(np.shares_memory(a.image, b.image) for a, b in itertools.combinations(frames, 2))
    require(not shared, "two frames share the memory of their images")
    require([snapshot(frame) for frame in frames] == kept, "a frame that was read changes later")


def _check_options(case: PerceptionCase) -> None:
    def use(build: Callable[[], PerceptionSource]) -> None:
        with started(case, build, lambda source: source.open()) as source:
            _read(case, source, topics)

    topics = MemoryTopics()
    check_options_read(case, use, topics)


def _check_memory(case: PerceptionCase) -> None:
    topics = MemoryTopics(ros_clock, history=1)
    with started(
        case, attempt(case, lambda: case.prepare(topics)), lambda source: source.open()
    ) as source:
        check_memory(lambda: _read(case, source, topics), "read", count=FRAMES)


def _check_every_camera(case: PerceptionCase) -> None:
    if case.feed is not None:
        raise NotApplicable("the case feeds what is to be read")
    wanted = {camera.name for camera in case.profiles()}
    with _open(case) as (source, topics):
        seen = {_read(case, source, topics).camera for _ in range(4 * len(wanted))}
    require(wanted <= seen, f"no frame came of {', '.join(sorted(wanted - seen))}")


def _timed_read(source: PerceptionSource, timeout_s: float) -> tuple[float, bool]:
    """How long a read takes [s] and whether a frame came."""
    begun_s = time.monotonic()
    try:
        frame = source.read(timeout_s)
    except NotReadyError:
        return time.monotonic() - begun_s, False
    require(
        isinstance(frame, Frame),
        f"read returned {type(frame).__name__}, expected a Frame or NotReadyError",
    )
    return time.monotonic() - begun_s, True


def _check_bounded(case: PerceptionCase) -> None:
    with _open(case) as (source, _):
        for timeout_s in (SHORT_READ_S, 0.0):
            limit_s = timeout_s + LATE_S
            took_s = min(
                within(case.timeout_s + 2.0, lambda t=timeout_s: _timed_read(source, t), "read")[0]  # type: ignore[misc]
                for _ in range(READS)
            )
            require(
                took_s <= limit_s, f"read with a time-out of {timeout_s:g} s takes {took_s:.2f} s"
            )


def _check_waits(case: PerceptionCase) -> None:
    with _open(case) as (source, _):
        for _ in range(20):
            took_s, has_frame = _timed_read(source, LONG_READ_S)
            if not has_frame:
                break
    early = not has_frame and took_s < 0.8 * LONG_READ_S
    require(not early, f"read with a time-out of {LONG_READ_S:g} s gives up after {took_s:.3f} s")


def _check_no_cameras(case: PerceptionCase) -> None:
    none = replace(case, cameras=lambda: (), is_automatic=False)
    try:
        with _open(none) as (source, _):
            _timed_read(source, SHORT_READ_S)
    except RoboNeuronError:
        return
    except Violation:
        raise
    except Exception as error:
        raise Violation(f"without cameras it raised {type(error).__name__}: {error}") from error


_SOURCE = "roboneuron.contract.protocols.PerceptionSource"


def _rule(
    name: str, text: str, check: Callable[[PerceptionCase], None], source: str = f"{_SOURCE}.read"
) -> Rule[PerceptionCase]:
    return Rule(id=f"perception/{name}", text=text, source=source, check=check)


RULES: tuple[Rule[PerceptionCase], ...] = (
    *LIFECYCLE.rules(without=("memory-bounded", "options-read")),
    _rule("options-read", OPTIONS_READ, _check_options, _SOURCE),
    _rule(
        "constructor-leaves-topics",
        "The constructor neither subscribes nor advertises.",
        _check_topics_untouched,
        "roboneuron.contract.protocols.Topics",
    ),
    _rule(
        "frame-of-a-camera",
        "A frame is of a camera that was asked for, with that camera's frame_id and size.",
        _check_frame,
    ),
    _rule(
        "frame-expected",
        "A frame shows what the case expects, red first and upright.",
        _check_content,
    ),
    _rule(
        "calibration-kept",
        "A frame carries its camera's calibration; none when the profile has none for its size.",
        _check_calibration,
        "roboneuron.contract.observation.Frame",
    ),
    _rule(
        "frame-once",
        "A frame is returned once; without a new one `read` raises NotReadyError.",
        _check_once,
    ),
    _rule("pace-kept", "Frames come no faster than the source's own options say.", _check_rate),
    _rule(
        "stamps-in-ros-time",
        "A frame is stamped in nanoseconds of `Topics.now_ns`, neither before `open` nor in the "
        "future.",
        _check_stamps,
        "roboneuron.contract.observation.Frame",
    ),
    _rule(
        "stamps-of-capture",
        "A frame is stamped when it was captured, not when it is read.",
        _check_capture,
        "roboneuron.contract.observation.Frame",
    ),
    _rule(
        "frames-in-order",
        "Frames of one camera come in the order of their capture times, which differ.",
        _check_order,
        "roboneuron.contract.observation.Frame",
    ),
    _rule("frames-own-memory", "A frame is not written to by a later one.", _check_own_memory),
    _rule("memory-bounded", "Memory does not grow with every `read`.", _check_memory),
    _rule(
        "every-camera-served",
        "Frames come of every camera that was asked for.",
        _check_every_camera,
    ),
    _rule(
        "read-bounded",
        "`read` returns or raises NotReadyError when its time-out is over.",
        _check_bounded,
    ),
    _rule(
        "read-waits", "`read` raises NotReadyError only when its time-out is over.", _check_waits
    ),
    _rule(
        "no-cameras-refused",
        "Without cameras the source is refused or idle.",
        _check_no_cameras,
        f"{_SOURCE}.open",
    ),
)
"""Rules of perception sources."""

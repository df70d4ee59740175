"""Rules of perception sources on time: correct stamps, the declared rate, bounded reads."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rn_testing.cases import PerceptionCase
from rn_testing.effects import within
from rn_testing.fakes import MemoryTopics
from rn_testing.rule import NotApplicable, Rule, Violation, require
from rn_testing.rules.clock import FUTURE_S, PAST_S, later, ros_clock
from rn_testing.rules.perception import (
    FRAMES,
    SHORT_READ_S,
    SOURCE,
    feed,
    opened,
    perception_rule,
    read_frame,
    take_frame,
)
from roboneuron import (
    Frame,
    NotReadyError,
    PerceptionSource,
    RoboNeuronError,
)

LATE_S = 0.15
"""Tolerated delay of the quickest of five reads beyond its time-out; a busy machine slows single
reads, not all.
"""
READS = 5
"""Number of reads, of which the quickest counts."""
LONG_READ_S = 0.3
"""Time-out of a read without input [s]."""
FEED_S = 0.3
"""Time between feeding and reading a frame, to tell from its stamp when it was taken [s]."""
MANY_FRAMES, LOOK_S = 40, 1.0
"""Number of frames whose order is checked; of slow cameras those that arrive in this time, at least
FRAMES.
"""
RATE_OPTIONS = ("rate_hz", "fps", "frame_rate_hz")
"""Options of sources for the frame rate of each camera."""
TOO_FAST = 2.0
"""Factor on the declared rate beyond rounding; a lower rate is possible on a busy machine."""


def _check_stamps(case: PerceptionCase) -> None:
    with opened(case) as (source, topics):
        opened_ns = ros_clock()
        for _ in range(FRAMES):
            stamp_ns = read_frame(case, source, topics).stamp_ns
            now_ns = ros_clock()
            early_s, late_s = (opened_ns - stamp_ns) / 1e9, (stamp_ns - now_ns) / 1e9
            require(
                late_s <= FUTURE_S, f"a frame is stamped {late_s:.3g} s in the future of ROS time"
            )
            require(
                early_s <= PAST_S,
                f"a frame is stamped {early_s:.3g} s before open() in ROS time, in nanoseconds",
            )


def _check_later(case: PerceptionCase) -> None:
    with opened(case) as (source, topics):
        for _ in range(FRAMES):
            read_frame(case, source, topics)
        with later():
            # the first ones may have been captured before
            frames = [read_frame(case, source, topics) for _ in range(2 * FRAMES)]
            age_s = (ros_clock() - frames[-1].stamp_ns) / 1e9
    require(
        -FUTURE_S <= age_s <= PAST_S / 2,
        f"an hour after the first frames a new one is stamped {age_s:.3g} s ago",
    )


def _check_capture(case: PerceptionCase) -> None:
    if case.feed is None:
        raise NotApplicable("frames come by themselves")
    with opened(case) as (source, topics):
        feed(case, source, topics)
        fed_ns = ros_clock()
        time.sleep(FEED_S)
        stamp_ns = take_frame(case, source).stamp_ns
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
        yield read_frame(case, source, topics)


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
    with opened(case) as (source, topics):
        for frame in _frames(case, source, topics):
            stamps.setdefault(frame.camera, []).append(frame.stamp_ns)
    for camera, found in stamps.items():
        if len(found) >= 3:
            pace_hz = 1e9 / max(1.0, float(np.median(np.diff(found))))
            told = f"frames of {camera!r} come at {pace_hz:.3g} Hz, declared {rate_hz:g} Hz"
            require(pace_hz <= TOO_FAST * rate_hz, told)


def _check_once(case: PerceptionCase) -> None:
    if case.feed is None:
        raise NotApplicable("frames come by themselves")
    with opened(case) as (source, topics):
        first = read_frame(case, source, topics)
        for _ in range(FRAMES):  # the input may have given more frames, but not endlessly many
            try:
                again = source.read(SHORT_READ_S)
            except NotReadyError:
                return
            same = again.camera == first.camera and np.array_equal(again.image, first.image)
            require(not same, f"a frame of {first.camera!r} that was read is returned again")


def _check_order(case: PerceptionCase) -> None:
    newest: dict[str, int] = {}
    with opened(case) as (source, topics):
        for frame in _frames(case, source, topics):
            before = newest.get(frame.camera, 0)
            require(
                frame.stamp_ns > before,
                f"a frame of {frame.camera!r} is not stamped after the one read last",
            )
            newest[frame.camera] = frame.stamp_ns


def _timed_read(source: PerceptionSource, timeout_s: float) -> tuple[float, bool]:
    """Duration of a read [s], and whether a frame came."""
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
    with opened(case) as (source, _):
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
    with opened(case) as (source, _):
        for _ in range(20):
            took_s, has_frame = _timed_read(source, LONG_READ_S)
            if not has_frame:
                break
    early = not has_frame and took_s < 0.8 * LONG_READ_S
    require(not early, f"read with a time-out of {LONG_READ_S:g} s gives up after {took_s:.3f} s")


def _check_no_cameras(case: PerceptionCase) -> None:
    none = replace(case, cameras=lambda: (), is_automatic=False)
    try:
        with opened(none) as (source, _):
            _timed_read(source, SHORT_READ_S)
    except RoboNeuronError:
        return
    except Violation:
        raise
    except Exception as error:
        raise Violation(f"without cameras it raised {type(error).__name__}: {error}") from error


RULES: tuple[Rule[PerceptionCase], ...] = (
    perception_rule(
        "frame-once",
        "A frame is returned once; without a new one `read` raises NotReadyError.",
        _check_once,
    ),
    perception_rule(
        "pace-kept", "Frames come no faster than the source's own options say.", _check_rate
    ),
    perception_rule(
        "stamps-in-ros-time",
        "A frame is stamped in nanoseconds of `Topics.now_ns`, neither before `open` nor in the "
        "future.",
        _check_stamps,
        "roboneuron.contract.observation.Frame",
    ),
    perception_rule(
        "stamps-do-not-drift",
        "An hour later frames are stamped as they were before.",
        _check_later,
        "roboneuron.contract.observation.Frame",
    ),
    perception_rule(
        "stamps-of-capture",
        "A frame is stamped when it was captured, not when it is read.",
        _check_capture,
        "roboneuron.contract.observation.Frame",
    ),
    perception_rule(
        "frames-in-order",
        "Frames of one camera come in the order of their capture times, which differ.",
        _check_order,
        "roboneuron.contract.observation.Frame",
    ),
    perception_rule(
        "read-bounded",
        "`read` returns or raises NotReadyError when its time-out is over.",
        _check_bounded,
    ),
    perception_rule(
        "read-waits", "`read` raises NotReadyError only when its time-out is over.", _check_waits
    ),
    perception_rule(
        "no-cameras-refused",
        "Without cameras the source is refused or idle.",
        _check_no_cameras,
        f"{SOURCE}.open",
    ),
)
"""Rules of perception sources on time."""

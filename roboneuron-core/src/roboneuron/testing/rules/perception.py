"""Rules of perception sources: frames of the cameras asked for, in bounded time, each with memory of its own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from roboneuron.contract import Frame, PerceptionSource
from roboneuron.errors import NotReadyError, StateError
from roboneuron.testing.cases import PerceptionCase
from roboneuron.testing.effects import expect_refusal, within
from roboneuron.testing.fakes import MemoryTopics
from roboneuron.testing.lifecycle import (
    attempt,
    check_close_before_start,
    check_close_twice_and_release,
    check_protocol,
    check_pure_constructor,
    started,
)
from roboneuron.testing.rule import Rule, require

GRACE_S = 2.0
"""How much later than its timeout `read` may return on a busy machine."""
SHORT_READ_S = 0.05
"""Timeout of the read that nothing is fed for."""


@contextmanager
def _open(case: PerceptionCase) -> Iterator[tuple[PerceptionSource, MemoryTopics]]:
    topics = MemoryTopics()
    with started(case, lambda: case.build(topics), lambda source: source.open()) as source:
        yield source, topics


def _read(case: PerceptionCase, source: PerceptionSource, topics: MemoryTopics) -> Frame:
    if case.feed is not None:
        case.feed(source, topics)
    frame = attempt(case, lambda: within(case.timeout_s + GRACE_S, lambda: source.read(case.timeout_s), "read"))
    require(isinstance(frame, Frame), f"read returned {type(frame).__name__}, expected a Frame")
    return frame


def _check_protocol(case: PerceptionCase) -> None:
    check_protocol(attempt(case, lambda: case.build(MemoryTopics())), PerceptionSource)


def _check_pure(case: PerceptionCase) -> None:
    check_pure_constructor(case, lambda: case.build(MemoryTopics()))


def _check_topics_untouched(case: PerceptionCase) -> None:
    topics = MemoryTopics()
    attempt(case, lambda: case.build(topics))
    require(not topics.used, f"the constructor uses the topics {', '.join(topics.used)}; that belongs into open()")


def _check_close_first(case: PerceptionCase) -> None:
    check_close_before_start(case, lambda: case.build(MemoryTopics()))


def _check_frame(case: PerceptionCase) -> None:
    with _open(case) as (source, topics):
        frame = _read(case, source, topics)
    profiles = {c.name: c for c in case.profiles()}
    require(frame.camera in profiles, f"a frame is of camera {frame.camera!r}, asked for: {', '.join(profiles)}")
    require(frame.stamp_ns > 0, f"a frame is stamped {frame.stamp_ns}, expected its capture time")
    wanted = profiles[frame.camera].frame_id
    require(frame.frame_id == wanted, f"a frame has frame_id {frame.frame_id!r}, the profile says {wanted!r}")


def _check_order(case: PerceptionCase) -> None:
    newest: dict[str, int] = {}
    with _open(case) as (source, topics):
        for _ in range(4):
            frame = _read(case, source, topics)
            before = newest.get(frame.camera, 0)
            require(frame.stamp_ns >= before, f"a frame of {frame.camera!r} is stamped before the one read last")
            newest[frame.camera] = frame.stamp_ns


def _check_own_memory(case: PerceptionCase) -> None:
    with _open(case) as (source, topics):
        first = _read(case, source, topics)
        second = _read(case, source, topics)
    require(not np.shares_memory(first.image, second.image), "two frames share the memory of their images")


def _check_bounded(case: PerceptionCase) -> None:
    def read() -> None:
        try:
            source.read(SHORT_READ_S)
        except NotReadyError:
            return

    with _open(case) as (source, _):
        within(SHORT_READ_S + GRACE_S, read, f"read with a timeout of {SHORT_READ_S:g} s")


def _check_read_first(case: PerceptionCase) -> None:
    source = attempt(case, lambda: case.build(MemoryTopics()))
    try:
        expect_refusal(lambda: source.read(SHORT_READ_S), "read before open", StateError)
    finally:
        source.close()


def _check_read_last(case: PerceptionCase) -> None:
    with _open(case) as (source, _):
        pass
    expect_refusal(lambda: source.read(SHORT_READ_S), "read after close", StateError)


def _check_release(case: PerceptionCase) -> None:
    check_close_twice_and_release(case, lambda: case.build(MemoryTopics()), lambda source: source.open())


_SOURCE = "roboneuron.contract.protocols.PerceptionSource"

RULES: tuple[Rule[PerceptionCase], ...] = (
    Rule(
        id="perception/protocol", text="It has the methods of PerceptionSource.", source=_SOURCE, check=_check_protocol
    ),
    Rule(
        id="perception/constructor-pure",
        text="The constructor opens no file, starts no thread or process and computes nothing that takes time.",
        source="roboneuron.contract.protocols",
        check=_check_pure,
    ),
    Rule(
        id="perception/constructor-leaves-topics",
        text="The constructor subscribes to nothing and advertises nothing.",
        source="roboneuron.contract.protocols",
        check=_check_topics_untouched,
    ),
    Rule(
        id="perception/close-before-open",
        text="`close` may be called twice and before `open`.",
        source=f"{_SOURCE}.close",
        check=_check_close_first,
    ),
    Rule(
        id="perception/frame-of-a-camera",
        text="`read` returns a frame of a camera asked for, with its frame_id and capture time.",
        source=f"{_SOURCE}.read",
        check=_check_frame,
    ),
    Rule(
        id="perception/frames-in-order",
        text="Frames of one camera come in the order of their capture times.",
        source="roboneuron.contract.observation.Frame",
        check=_check_order,
    ),
    Rule(
        id="perception/frames-own-memory",
        text="A frame's image is not written to by a later one.",
        source=f"{_SOURCE}.read",
        check=_check_own_memory,
    ),
    Rule(
        id="perception/read-bounded",
        text="`read` returns or raises NotReadyError when its timeout is over.",
        source=f"{_SOURCE}.read",
        check=_check_bounded,
    ),
    Rule(
        id="perception/read-before-open-refused",
        text="`read` before `open` is a StateError.",
        source=f"{_SOURCE}.read",
        check=_check_read_first,
    ),
    Rule(
        id="perception/read-after-close-refused",
        text="`read` after `close` is a StateError.",
        source=f"{_SOURCE}.read",
        check=_check_read_last,
    ),
    Rule(
        id="perception/close-releases",
        text="After `open`, `close` may be called twice and leaves no thread or process behind.",
        source=f"{_SOURCE}.close",
        check=_check_release,
    ),
)
"""Rules of perception sources."""

"""Recordings by clocks that a test sets."""

from __future__ import annotations

from pathlib import Path

from rn_recorder_runs.files import (
    Record,
)
from rn_recorder_runs.images import to_string
from rn_recorder_runs.recording import Recording, Rules
from rn_recorder_runs.store import RunStore

STRING = "std_msgs/msg/String"
START_NS = 1_700_000_000_000_000_000


def record(number: int, at_ns: int | None = None, topic: str = "/told") -> Record:
    at = START_NS + number * 10_000_000 if at_ns is None else at_ns
    return Record(topic, STRING, at, at - 1000, number, to_string(f"message {number} " + "x" * 200))


class Clock:
    """Wall clock and monotonic clock that a test sets."""

    def __init__(self) -> None:
        self.s = 0.0

    def ns(self) -> int:
        return START_NS + round(self.s * 1e9)

    def monotonic(self) -> float:
        return self.s


def recording(tmp_path: Path, clock: Clock, **rules: float) -> Recording:
    made = Recording(
        RunStore(tmp_path / "runs"),
        Rules(**{"min_free_bytes": 0, **rules}),  # type: ignore[arg-type]
        {"robot": "gantry"},
        clock_ns=clock.ns,
        monotonic=clock.monotonic,
    )
    made.adopt()
    return made


def feed(made: Recording, clock: Clock, seconds: float, rate: int = 20, number: int = 0) -> int:
    for _ in range(round(seconds * rate)):
        number += 1
        clock.s += 1 / rate
        made.take(record(number, clock.ns()))
        made.tick()
    return number

"""list_incidents: kinds with counts, severity, longest and now, worst first; of this robot."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rn_standard.ops.incidents import FaultSpans, Incidents
from rn_standard.ops.records import incident_kinds


class Clock:
    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


def test_kinds_come_worst_first_with_counts_and_times() -> None:
    records = [
        {"module": "inference", "what": "stalled", "at": f"2026-01-01T00:0{minute}:00+00:00"}
        for minute in (3, 2, 1)
    ]
    records.append({"module": "robot", "what": "exited", "at": "2026-01-01T00:00:00+00:00"})
    worst, other = incident_kinds(records, FaultSpans(Clock()))
    assert (worst.module, worst.severity, worst.count, worst.now) == ("robot", "high", 1, False)
    assert (other.severity, other.count) == ("low", 3)
    assert (other.first[14:16], other.last[14:16]) == ("01", "03")


def test_what_is_so_now_comes_first_with_the_longest_time() -> None:
    clock = Clock()
    spans = FaultSpans(clock)
    records = [
        {"module": "robot", "what": "exited", "at": "b"},
        {"module": "inference", "what": "stalled", "at": "a"},
    ]
    spans.change("inference", "ok", "stalled")
    clock.now_s += 4.0
    spans.change("inference", "stalled", "ok")
    spans.change("inference", "ok", "stalled")
    clock.now_s += 1.0
    first, _ = incident_kinds(records, spans)
    assert (first.what, first.now, first.longest_s) == ("stalled", True, 4.0)


@pytest.mark.parametrize(
    ("what", "lasts_s", "is_over", "severity"),
    [
        ("silent", 0.3, True, "low"),
        ("stuck", 0.3, True, "low"),
        ("silent", 1.5, True, "high"),
        ("silent", 0.3, False, "high"),
        ("exited", 0.3, True, "high"),
        ("failing", 0.3, True, "medium"),
    ],
)
def test_a_hiccup_that_is_over_was_only_late(
    what: str, lasts_s: float, is_over: bool, severity: str
) -> None:
    clock = Clock()
    spans = FaultSpans(clock)
    spans.change("control", "ok", what)
    clock.now_s += lasts_s
    if is_over:
        spans.change("control", what, "ok")
    (kind,) = incident_kinds([{"module": "control", "what": what, "at": "a"}], spans)
    assert kind.severity == severity


def test_a_record_names_its_robot(tmp_path: Path) -> None:
    Incidents(tmp_path, robot=lambda: "real robot one").record("robot", "exited", {})
    (record,) = Incidents(tmp_path).listing(5)
    assert record["robot"] == "real robot one"


def test_a_fault_that_repeats_is_one_record_until_that_is_removed(tmp_path: Path) -> None:
    incidents = Incidents(tmp_path / "records", monotonic=Clock())
    first = incidents.record("robot", "exited", {})
    assert first is not None
    assert incidents.record("robot", "exited", {}) is None
    shutil.rmtree(first.parent)
    second = incidents.record("robot", "exited", {})
    assert second is not None
    assert second.exists()

"""Operator, take-over and lease, with a clock in hand."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rn_standard.http.operator_lease import OperatorLease
from roboneuron.errors import RefusedError
from roboneuron.gate.audit import AuditLog

ACTS = SimpleNamespace(name="start_robot", read_only=False, always=False)
READS = SimpleNamespace(name="get_status", read_only=True, always=False)
STOPS = SimpleNamespace(name="emergency_stop", read_only=False, always=True)


class Operated:
    """The lease, with the time and what was ended."""

    def __init__(self, folder: Path, lease_s: float | None, *, by_streams: bool = True) -> None:
        self.now_s = 100.0
        self.lapses: list[str] = []
        self.audit = folder / "audit.jsonl"
        self.lease = OperatorLease(
            lease_s,
            AuditLog(self.audit, lambda: 1),
            self.lapses.append,
            clock=lambda: self.now_s,
            by_streams=by_streams,
        )

    def call(self, tool: Any, who: str) -> None:
        self.lease.admit(tool, SimpleNamespace(who=who, role="operator", simulated=False))  # type: ignore[arg-type]


def test_only_one_client_acts_and_everybody_reads_and_stops(tmp_path: Path) -> None:
    robot = Operated(tmp_path, None)
    robot.call(READS, "bob")
    robot.call(ACTS, "ann")
    robot.call(READS, "bob")
    robot.call(STOPS, "bob")
    with pytest.raises(RefusedError, match="'ann' operates the robot"):
        robot.call(ACTS, "bob")
    assert robot.lease.take_over("bob", "operator") == "ann"
    robot.call(ACTS, "bob")
    with pytest.raises(RefusedError):
        robot.call(ACTS, "ann")
    (record,) = [json.loads(line) for line in robot.audit.read_text().splitlines()]
    assert (record["who"], record["tool"], record["reason"]) == (
        "bob",
        "take_over",
        "took over from ann",
    )
    robot.now_s += 1e6
    robot.lease.look()
    assert robot.lapses == []


def test_a_silent_operator_loses_the_robot_once(tmp_path: Path) -> None:
    robot = Operated(tmp_path, 2.0)
    robot.lease.look()
    robot.call(ACTS, "ann")
    for _ in range(3):
        robot.now_s += 1.5
        robot.call(READS, "ann")
        robot.call(READS, "bob")
        robot.lease.look()
    assert robot.lapses == []
    robot.now_s += 1.5
    robot.call(READS, "bob")
    robot.now_s += 0.6
    for _ in range(2):
        robot.lease.look()
    (reason,) = robot.lapses
    assert "'ann' has lapsed: silent for 2.10 s, 2 s are allowed" in reason
    robot.call(ACTS, "bob")


def test_what_the_operator_holds_open_renews_the_lease(tmp_path: Path) -> None:
    robot = Operated(tmp_path, 2.0)
    with robot.lease.present("bob"):  # somebody else's stream
        robot.call(ACTS, "ann")
        with robot.lease.present("ann"):
            with robot.lease.present("ann"):
                robot.now_s += 100.0
            robot.now_s += 100.0
            robot.lease.look()
        robot.now_s += 1.9
        robot.lease.look()
        assert robot.lapses == []
        robot.now_s += 0.2
        robot.lease.look()
    assert "silent for 2.10 s" in robot.lapses[0]


def test_a_lease_of_calls_only_lapses_though_a_stream_is_open(tmp_path: Path) -> None:
    robot = Operated(tmp_path, 2.0, by_streams=False)
    robot.call(ACTS, "ann")
    with robot.lease.present("ann"):
        robot.now_s += 2.1
        robot.lease.look()
    assert len(robot.lapses) == 1


@pytest.mark.parametrize("lease_s", [None, 60.0])
def test_who_has_left_hands_the_robot_to_the_next_who_acts(
    tmp_path: Path, lease_s: float | None
) -> None:
    robot = Operated(tmp_path, lease_s)
    robot.call(ACTS, "ann")
    robot.lease.release("bob")
    with pytest.raises(RefusedError):
        robot.call(ACTS, "bob")
    robot.lease.release("ann")
    robot.call(READS, "bob")
    robot.call(ACTS, "bob")
    with pytest.raises(RefusedError, match="'bob' operates"):
        robot.call(ACTS, "ann")


def test_who_has_left_and_is_followed_by_nobody_still_ends_motion(tmp_path: Path) -> None:
    robot = Operated(tmp_path, 60.0)
    robot.call(ACTS, "ann")
    robot.lease.release("ann")
    robot.now_s += 61.0
    robot.lease.look()
    assert "'ann' has lapsed" in robot.lapses[0]

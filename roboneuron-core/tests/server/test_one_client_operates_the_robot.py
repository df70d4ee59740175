"""Operator, take-over and lease, with a clock in hand."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from roboneuron.errors import RefusedError
from roboneuron.gate.audit import AuditLog
from roboneuron.server.operating import Operating

ACTS = SimpleNamespace(name="start_robot", read_only=False, always=False)
READS = SimpleNamespace(name="get_status", read_only=True, always=False)
STOPS = SimpleNamespace(name="emergency_stop", read_only=False, always=True)


class Desk:
    """Operating, with the time and what was ended."""

    def __init__(self, folder: Path, lease_s: float | None) -> None:
        self.now_s = 100.0
        self.lapses: list[str] = []
        self.audit = folder / "audit.jsonl"
        self.operating = Operating(
            lease_s, AuditLog(self.audit, lambda: 1), self.lapses.append, clock=lambda: self.now_s
        )

    def call(self, tool: Any, who: str) -> None:
        self.operating.admit(tool, SimpleNamespace(who=who, role="operator"))  # type: ignore[arg-type]


def test_only_one_client_acts_and_everybody_reads_and_stops(tmp_path: Path) -> None:
    desk = Desk(tmp_path, None)
    desk.call(READS, "bob")
    desk.call(ACTS, "ann")
    desk.call(READS, "bob")
    desk.call(STOPS, "bob")
    with pytest.raises(RefusedError, match="'ann' operates the robot"):
        desk.call(ACTS, "bob")
    assert desk.operating.take_over("bob", "operator") == "ann"
    desk.call(ACTS, "bob")
    with pytest.raises(RefusedError):
        desk.call(ACTS, "ann")
    (record,) = [json.loads(line) for line in desk.audit.read_text().splitlines()]
    assert (record["who"], record["tool"], record["reason"]) == ("bob", "take_over", "took over from ann")
    desk.now_s += 1e6
    desk.operating.look()
    assert desk.lapses == []


def test_a_silent_operator_loses_the_robot_once(tmp_path: Path) -> None:
    desk = Desk(tmp_path, 2.0)
    desk.operating.look()
    desk.call(ACTS, "ann")
    for _ in range(3):
        desk.now_s += 1.5
        desk.call(READS, "ann")
        desk.call(READS, "bob")
        desk.operating.look()
    assert desk.lapses == []
    desk.now_s += 1.5
    desk.call(READS, "bob")
    desk.now_s += 0.6
    for _ in range(2):
        desk.operating.look()
    (reason,) = desk.lapses
    assert "'ann' has lapsed: silent for 2.10 s, 2 s are allowed" in reason
    desk.call(ACTS, "bob")

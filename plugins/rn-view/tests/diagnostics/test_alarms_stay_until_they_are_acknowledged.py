"""Alarms: raised by what goes wrong, counted, bounded, kept across a restart, and acknowledged by a
person with a record in the audit.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from rn_view.diagnostics.alarm_rules import STOP, AlarmRules
from rn_view.diagnostics.alarms import FILE_NAME, AlarmBook
from roboneuron import InvalidInputError, RefusedError
from roboneuron.feature import StillReason
from roboneuron.gate.audit import AuditLog


class Kept:
    """A book with a clock in hand."""

    def __init__(self, folder: Path, kept: int = 200) -> None:
        self.now_s = 1000.0
        self.folder = folder
        self.audit = AuditLog.in_directory(folder)
        self.book = AlarmBook(folder, self.audit, clock=lambda: self.now_s, kept=kept)
        self.rules = AlarmRules(self.book, clock=lambda: self.now_s)

    def told(self) -> list[tuple[str, str, int]]:
        return [(one.source, one.what, one.count) for one in self.book.newest()]


@pytest.fixture
def kept(tmp_path: Path) -> Kept:
    return Kept(tmp_path)


def record(at_s: float, **facts: Any) -> dict[str, Any]:
    return {"time_ns": int(at_s * 1e9), "who": "control", "reason": "", "rule": "", **facts}


def reason(rule: str, message: str) -> StillReason:
    return StillReason(rank="module", rule=rule, message=message, hint="Start it.")


def test_a_dead_module_is_an_alarm_that_says_what_to_do(kept: Kept) -> None:
    kept.rules.on_health("control", "exited", reason("exited", "It has ended."))
    kept.rules.on_health("inference", "failing", reason("failing", "no weights"))
    policy, control = sorted(kept.book.newest(), key=lambda one: one.source, reverse=True)
    assert (control.cause, control.advice) == ("It has ended.", "Start it.")
    assert policy.cause == "no weights"
    kept.now_s = 1005.0
    kept.rules.on_health("control", "ok")
    (over,) = [one for one in kept.book.newest() if one.source == "control"]
    assert over.over_s == 1005.0
    assert over.is_open, "what is over is acknowledged all the same"


def test_a_report_that_is_late_for_less_than_a_second_is_no_alarm(kept: Kept) -> None:
    kept.rules.on_health("robot", "silent", reason("silent", "It does not report."))
    kept.now_s += 0.9
    kept.rules.poll()
    kept.rules.on_health("robot", "ok")
    kept.now_s += 5.0
    kept.rules.poll()
    assert kept.told() == []
    kept.rules.on_health("robot", "silent", reason("silent", "It does not report."))
    kept.now_s += 1.0
    kept.rules.poll()
    kept.rules.poll()
    assert kept.told() == [("robot", "silent", 1)]


def test_the_same_alarm_is_counted_until_it_is_acknowledged(kept: Kept) -> None:
    for at_s in (1, 2, 3):
        zone = "The TCP would enter 'table'."
        kept.rules.on_record(record(at_s, verdict="held", rule="zone", reason=zone))
    assert kept.told() == [("control", "hold: zone", 3)]
    (alarm,) = kept.book.newest()
    assert (alarm.first_s, alarm.last_s, alarm.cause) == (1.0, 3.0, zone)
    kept.book.acknowledge(alarm.number, "ann", "operator")
    kept.rules.on_record(record(4, verdict="held", rule="zone", reason=zone))
    assert kept.told() == [("control", "hold: zone", 1), ("control", "hold: zone", 3)]


@pytest.mark.parametrize(
    ("facts", "expected"),
    [
        ({"verdict": "scaled", "rule": "velocity"}, ("control", "limit: velocity", True)),
        ({"verdict": "held", "rule": "no_action"}, ("control", "hold: no_action", False)),
        ({"verdict": "latched", "who": "ann"}, (STOP, "pressed", False)),
        (
            {"verdict": "restored", "who": "server"},
            (STOP, "its file was deleted; written again", False),
        ),
        ({"verdict": "refused", "who": "agent"}, None),
        ({"verdict": "allowed", "who": "agent"}, None),
    ],
)
def test_stops_limits_and_holds_are_alarms_and_what_is_refused_to_an_agent_is_none(
    kept: Kept, facts: dict[str, Any], expected: tuple[str, str, bool] | None
) -> None:
    kept.rules.on_record(record(5, **facts))
    found = [(one.source, one.what, one.is_warning) for one in kept.book.newest()]
    assert found == ([] if expected is None else [expected])


def test_a_fallback_is_a_warning_each_time_it_takes_over(kept: Kept) -> None:
    for count in ("0", "1", "1", "2"):
        acting = {"fallback.count": count, "fallback.acting": "servo", "fallback.reason": "late"}
        kept.rules.on_metrics(acting)
    assert kept.told() == [("inference", "fallback", 2)]
    kept.rules.on_metrics({"fallback.count": "?"})
    kept.rules.on_metrics({})
    assert "servo is in use: late" in kept.book.newest()[0].cause


def test_the_release_of_the_stop_ends_its_alarm(kept: Kept) -> None:
    kept.rules.on_record(record(5, verdict="latched", who="ann", reason="a hand"))
    kept.rules.on_record(record(9, verdict="allowed", who="bob", tool="reset_emergency_stop"))
    (alarm,) = kept.book.newest()
    assert (alarm.cause, alarm.over_s, alarm.is_open) == ("ann: a hand", 9.0, True)


def test_who_acknowledges_and_when_is_kept_and_in_the_audit(kept: Kept) -> None:
    number = kept.book.add("robot", "exited", "gone", "start it").number
    kept.now_s = 1010.0
    seen = kept.book.acknowledge(number, "ann", "operator")
    assert (seen.acknowledged_by, seen.acknowledged_s) == ("ann", 1010.0)
    assert kept.book.acknowledge(number, "bob", "operator") == seen, "the first one stays"
    (line,) = [json.loads(text) for text in kept.audit.path.read_text().splitlines()]
    assert (line["who"], line["tool"], line["arguments"]["alarm"]) == (
        "ann",
        "acknowledge_alarm",
        number,
    )
    with pytest.raises(InvalidInputError):
        kept.book.acknowledge(99, "ann", "operator")


def test_without_an_audit_nothing_is_acknowledged(
    kept: Kept, monkeypatch: pytest.MonkeyPatch
) -> None:
    number = kept.book.add("robot", "exited", "gone", "start it").number
    kept.audit.path.mkdir()
    with pytest.raises(RefusedError):
        kept.book.acknowledge(number, "ann", "operator")
    assert kept.book.newest()[0].is_open


def test_alarms_survive_a_restart_and_old_records_raise_none_again(
    kept: Kept, tmp_path: Path
) -> None:
    press = record(5, verdict="latched", who="ann", reason="a hand")
    kept.rules.on_record(press)
    kept.book.save()
    again = Kept(tmp_path)
    again.rules.on_record(press)
    assert again.told() == [(STOP, "pressed", 1)]
    assert again.book.newest() == kept.book.newest()


@pytest.mark.parametrize("text", ["", "{", "[]", '{"alarms": [{"number": 1}], "seen_ns": 0}'])
def test_a_damaged_file_is_an_alarm_itself(tmp_path: Path, text: str) -> None:
    (tmp_path / FILE_NAME).write_text(text)
    assert Kept(tmp_path).told() == [("server", "alarms lost", 1)]


def test_there_are_never_more_than_is_kept_and_those_that_were_seen_go_first(
    tmp_path: Path,
) -> None:
    few = Kept(tmp_path, kept=3)
    numbers = [few.book.add("robot", f"fault {i}", "x", "y").number for i in range(3)]
    few.book.acknowledge(numbers[1], "ann", "operator")
    few.book.add("robot", "fault 3", "x", "y")
    assert {what for _, what, _ in few.told()} == {"fault 0", "fault 2", "fault 3"}
    few.book.add("robot", "fault 4", "x", "y")
    assert {what for _, what, _ in few.told()} == {"fault 2", "fault 3", "fault 4"}


def test_a_long_cause_is_cut(kept: Kept) -> None:
    assert len(kept.book.add("robot", "x", "long " * 1000, "y").cause) == 300


def test_a_full_disk_stops_nothing(
    kept: Kept, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    kept.book.add("robot", "exited", "gone", "start it")
    kept.book.save()
    kept.book.save()
    assert [entry.message for entry in caplog.records if "No space left" in entry.message]
    monkeypatch.undo()
    kept.book.save()
    assert (kept.folder / FILE_NAME).exists()

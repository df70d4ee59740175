"""The table holds every module's numbers and faults, on an ASCII terminal too; /diagnostics and
get_status agree.
"""

from __future__ import annotations

import io
import os
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from rn_standard.console.diagnostics import DiagnosticsListener
from rn_standard.console.status import ModuleError, ReportedModule, ServerStatus
from rn_standard.console.status_command import exit_status
from rn_standard.console.table import duration, status_view


def module(name: str = "control", health: str = "ok", **facts: Any) -> ReportedModule:
    return ReportedModule(module=name, health=health, pid=7, **facts)


def shown(*statuses: ServerStatus, encoding: str = "utf-8", width: int = 80) -> str:
    raw = io.BytesIO()
    console = Console(
        file=io.TextIOWrapper(raw, encoding=encoding), width=width, markup=False, highlight=False
    )
    console.print(status_view(statuses))
    console.file.flush()
    return raw.getvalue().decode(encoding)


FULL = ServerStatus(
    source="test",
    namespace="fr3",
    pid=4242,
    uptime_s=200.0,
    modules=(
        module(
            "perception",
            rate_hz=20.04,
            latency_ms=18.52,
            latency_p99_ms=55.5,
            published=152,
            uptime_s=3725.0,
        ),
        module(
            "control", "failing", dropped=3, error=ModuleError(message="No pose [m].", hint="Look.")
        ),
        module(
            "inference", "waiting", waiting_for="ee_pose", instruction="pick [red]", note="looking"
        ),
        ReportedModule(module="robot", health="stopped"),
    ),
)


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_the_table_fits_a_terminal_of_80_columns_and_holds_everything(encoding: str) -> None:
    text = shown(FULL, encoding=encoding)
    assert max(len(line) for line in text.splitlines()) <= 80
    for words in (
        "/fr3, server pid 4242, up 3:20",
        "not latched",
        "20.0",
        "18.5",
        "55.5",
        "1:02:05",
        "152",
        "stopped",
    ):
        assert words in text
    for line in (
        "control: No pose [m]. Look.",
        "inference: waits for ee_pose",
        "inference: instruction 'pick [red]'",
    ):
        assert line in text


@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_numbers_are_shown_whole_or_not_at_all(width: int) -> None:
    busy = module(
        "perception",
        rate_hz=29.97,
        latency_ms=118.52,
        published=1234567,
        uptime_s=7405.0,
        dropped=54321,
    )
    text = shown(
        FULL.model_copy(update={"modules": (busy.model_copy(update={"pid": 4194304}),)}),
        width=width,
    )
    assert max(len(line) for line in text.splitlines()) <= width
    head, row = (text.splitlines()[i].split() for i in (2, 3))
    whole = {"pid": "4194304", "up": "2:03:25", "Hz": "30.0", "sent": "1234567", "dropped": "54321"}
    assert {column for column in whole if column in head} == {
        column for column in whole if whole[column] in row
    }
    assert "Hz" in head
    assert ("no room for: sent" in text) == (width < 80)


def test_the_emergency_stop_stands_out() -> None:
    text = shown(
        FULL.model_copy(update={"emergency_stop": True, "emergency_stop_cause": "ada: smoke"})
    )
    assert "EMERGENCY STOP latched by ada: smoke" in text


def test_what_keeps_the_robot_still_is_told_with_what_to_do() -> None:
    reasons = [
        {"rule": "emergency_stop", "message": "It is latched.", "hint": "A person releases it."},
        {"rule": "new_start", "message": "There was a stop.", "hint": "Ask\x1b[31m again."},
    ]
    text = shown(ServerStatus.from_answer({**FULL.model_dump(), "why_still": reasons}, "a test"))
    assert "There was a stop. Ask" in text
    assert "\x1b[31m" not in text
    assert "It is latched" not in text, "the line of the stop says it"


@pytest.mark.parametrize(
    ("status", "code"),
    [
        (ServerStatus(modules=(module(),)), 0),
        (ServerStatus(modules=(module(health="waiting"),)), 0),
        (ServerStatus(modules=(module(health="stuck"),)), 1),
        (ServerStatus(modules=(module(),), emergency_stop=True), 1),
        (ServerStatus(modules=(ReportedModule(module="robot", health="stopped"),)), 1),
        (ServerStatus(), 1),
    ],
)
def test_the_exit_status_is_0_only_when_something_runs_well(
    status: ServerStatus, code: int
) -> None:
    assert exit_status([status]) == code


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (59.9, "59 s"), (60.0, "1:00"), (7322.0, "2:02:02")]
)
def test_durations_are_short(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def message(name: str, pid: int, **values: str) -> Any:
    pairs = [SimpleNamespace(key=key, value=value) for key, value in values.items()]
    return SimpleNamespace(status=[SimpleNamespace(name=name, hardware_id=str(pid), values=pairs)])


def test_reports_of_modules_are_read_and_those_of_others_are_not(tmp_path: Any) -> None:
    listener = DiagnosticsListener(tmp_path)
    facts = {
        "state": "active",
        "ready": "true",
        "rate_hz": "20.0",
        "error_code": "",
        "loop_age_s": "0.01",
    }
    listener.receive(message("fr3/robot", os.getpid(), **facts))
    listener.receive(
        message("fr3/inference_2", os.getpid(), **{**facts, "error_code": "unsafe", "error": "NaN"})
    )
    listener.receive(message("fr3/supervisor/robot", os.getpid(), health="ok", before="starting"))
    listener.receive(message("somebody/else", 1, state="active"))
    listener.receive(message("fr3/control", 2**22 + 1, **facts))  # no such process
    (status,) = listener.read_status()
    found = [(m.module, m.health, m.rate_hz) for m in status.modules]
    assert found == [
        ("robot", "ok", 20.0),
        ("inference_2", "failing", 20.0),
        ("control", "exited", 20.0),
    ]
    assert status.modules[1].error is not None
    assert status.modules[1].error.message == "NaN"
    assert status.namespace == "fr3"
    assert not status.emergency_stop


def test_the_latch_is_that_of_the_robot_with_the_namespace_whatever_its_folder_is_called(
    tmp_path: Any,
) -> None:
    for name, namespace in (("left", "hall_2/a"), ("right", "hall_2/b")):
        (tmp_path / "robots" / name).mkdir(parents=True)
        (tmp_path / "robots" / name / "namespace").write_text(namespace)
    (tmp_path / "robots" / "right" / "emergency_stop.latched").write_text("{}")
    listener = DiagnosticsListener(tmp_path)
    facts = {"state": "active", "ready": "true", "error_code": "", "loop_age_s": "0.01"}
    for namespace in ("hall_2/a", "hall_2/b", "alone"):
        listener.receive(message(f"{namespace}/robot", os.getpid(), **facts))
    found = {status.namespace: status.emergency_stop for status in listener.read_status()}
    assert found == {"alone": False, "hall_2/a": False, "hall_2/b": True}


def test_nothing_heard_is_one_status_without_modules(tmp_path: Any) -> None:
    (tmp_path / "emergency_stop.latched").write_text("{}")
    (status,) = DiagnosticsListener(tmp_path).read_status()
    assert status.modules == ()
    assert status.emergency_stop
    assert "no module runs" in shown(status)

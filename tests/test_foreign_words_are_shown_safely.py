"""Whoever wrote a text (an agent, a ROS node, a file, a server), what a person sees of it in a
terminal, on the page or in a log can neither control the terminal nor hide or reverse anything.
"""

from __future__ import annotations

import asyncio
import json
import logging
import sys
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unicodedata import category

import pytest

from rn_interfaces.store import Origin
from rn_interfaces_learning.command import list_learnt
from rn_link.command import spoken
from rn_link.state import PeerConnection
from rn_recorder_runs.listing import list_runs
from rn_recorder_runs.store import RunStore
from rn_standard.console.plugins_list import print_short, print_table
from rn_standard.console.plugins_show import show
from rn_standard.console.status import ReportedModule, ServerStatus
from rn_standard.ops.maintenance import MaintenanceFile
from rn_standard.ops.maintenance_command import Maintenance
from rn_standard.tasks.approval import Approval
from rn_standard.tasks.options import TaskOptions
from rn_view.diagnostics.alarms import AlarmBook
from rn_view.diagnostics.event_list import EventList, add_record
from rn_view.visualization.markup import escape
from roboneuron import ConfigurationError, InvalidInputError, RefusedError
from roboneuron.cli import terminal
from roboneuron.estop import command as estop
from roboneuron.estop.latch import EmergencyStopLatch
from roboneuron.estop.pin import ReleasePin
from roboneuron.gate import AuditLog
from roboneuron.log_files import PlainFormatter, printable, quoted
from roboneuron.modules.report import Report
from roboneuron.plugins.registry import PluginRecord, Registry, Status
from roboneuron.tools.arm.limits_command import Limits

HOSTILE = {
    "escape": "\x1b[2J\x1b[31mall is well",
    "C1 escape": "\x9b2Jall is well",
    "bell and backspace": "\x07\b\b\ball is well",
    "carriage return": "latched\rThe emergency stop is not latched.",
    "line break": "x\nThe emergency stop is not latched.",
    "line separator": "x\u2028The emergency stop is not latched.\u2029\x85",
    "reversed": "\u202ellew si lla\u202c\u2066\u061c",
    "zero width": "a\u200bl\u200dl\u2060 \ufeffi\xads well\U000e0041",
    "half a pair": "a\ud800b",
    "many marks": "a" + "\u0301" * 500,
    "long": "all is well " * 2000,
}


def is_safe(text: str, lines: int = 1) -> bool:
    """No line more than expected, nothing that controls, hides or reverses."""
    shown = text.rstrip("\n")
    odd = [c for c in shown if category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp") and c != "\n"]
    is_stacked = "\u0301" * 5 in shown
    return not odd and not is_stacked and shown.count("\n") < lines and len(shown) < 3000


def run(command: object, *words: str) -> int:
    parser = ArgumentParser()
    command.configure(parser)  # type: ignore[attr-defined]
    status: int = command.run(parser.parse_args(words))  # type: ignore[attr-defined]
    return status


def pressed(text: str, folder: Path) -> EmergencyStopLatch:
    latch = EmergencyStopLatch.in_directory(folder)
    latch.latch(who=text[:200], reason=text)
    return latch


def estop_status(text: str, folder: Path) -> None:
    pressed(text, folder)
    assert run(estop, "--state", str(folder), "--status") == 1


def estop_reset(text: str, folder: Path) -> None:
    pressed(text, folder)
    assert run(estop, "--state", str(folder), "--reset") == 1


def refused_by_latch(text: str, folder: Path) -> None:
    with pytest.raises(RefusedError) as refusal:
        pressed(text, folder).check()
    print(refusal.value)


def status(text: str, folder: Path) -> None:
    answer = {"emergency_stop": True, "emergency_stop_cause": text}
    print(ServerStatus.from_answer(answer, "x").emergency_stop_cause)


def module_report(text: str, folder: Path) -> None:
    values = {"state": "active", "error_code": text, "error": text, "note": text}
    report = Report.from_values({**values, "instruction": text, "waiting_for": text})
    module = ReportedModule.from_report("control", 1, "ok", report)
    assert module.error is not None
    for shown in (
        module.note,
        module.instruction,
        module.waiting_for,
        *dict(module.error).values(),
    ):
        assert is_safe(str(shown))
    print(module.error.message)


def maintenance(text: str, folder: Path) -> None:
    MaintenanceFile(folder).begin(text, "admin", text, AuditLog.in_directory(folder))
    print(MaintenanceFile(folder).read())


def damaged_maintenance(text: str, folder: Path) -> None:
    content = {"who": text[:200], "reason": text[:200], "since_s": 5.0}
    (folder / "maintenance.json").write_text(json.dumps(content))
    print(MaintenanceFile(folder).read())


def error(text: str, folder: Path) -> None:
    terminal.show_error(InvalidInputError(text.replace("\n", " ")))


def file_error(text: str, folder: Path) -> None:
    terminal.show_error(OSError(2, "No such file", text))


def unexpected_error(text: str, folder: Path) -> None:
    terminal.show_error(RuntimeError(text))


def log_line(text: str, folder: Path) -> None:
    record = logging.LogRecord("x", 20, "", 0, "%s", (text[:1000].replace("\n", " "),), None)
    print(PlainFormatter().format(record))


def on_the_page(text: str, folder: Path) -> None:
    print(escape(text))


def event(text: str, folder: Path) -> None:
    events = EventList()
    add_record(events, {"verdict": "refused", "who": text, "tool": text, "reason": text})
    print(events.newest(1)[0].text)


def alarm(text: str, folder: Path) -> None:
    book = AlarmBook(folder, AuditLog.in_directory(folder))
    print(book.add("control", "x", text, "").cause)


def tightened(text: str, folder: Path) -> None:
    content = {"tightened": {"max_speed_m_s": 0.1}, "who": text[:200], "at_ns": 5}
    (folder / "limits.tightened.json").write_text(json.dumps(content))
    try:
        run(Limits(), "--state", str(folder))
    except ConfigurationError as error:
        terminal.show_error(error)


def registry_of(text: str) -> Registry:
    record = PluginRecord(
        name="odd",
        distribution="odd",
        version="1",
        module="odd",
        status=Status.FAILED,
        reason=text,
        traceback=text.replace("\n", " "),
    )
    return Registry(plugins=(record,), all_offers=())


def plugins_list(text: str, folder: Path) -> None:
    print_short(registry_of(text))


def plugins_verbose(text: str, folder: Path) -> None:
    print_table(registry_of(text))


def plugins_show(text: str, folder: Path) -> None:
    show(registry_of(text), "odd", None)


def runs_list(text: str, folder: Path) -> None:
    store = RunStore(folder)
    store.make()
    run = store.recordings / "20260101-000000-a"
    run.mkdir()
    said = text.encode("utf-8", "replace").decode()[:200]
    (run / "run.json").write_text(json.dumps({"name": "a", "state": said}))
    list_runs(store, as_json=False)


def ros_list(text: str, folder: Path) -> None:
    list_learnt({"a/msg/B": Origin(text, "RIHS01_0")}, as_json=False)


def link_status(text: str, folder: Path) -> None:
    print(spoken(PeerConnection(error=text)))


def approval(text: str, folder: Path) -> None:
    async def ask(question: str, what: str = "") -> str:
        print(question)
        return "yes"

    async def proceed(call: Any) -> Any:
        return None

    options = TaskOptions(approval=("run_task",), approval_roles=("operator",))
    (step,) = Approval(options, {"run_task": lambda parsed: ("carry out", text)}).interceptors()
    context = SimpleNamespace(role="operator", ask=ask)
    call: Any = SimpleNamespace(name="run_task", context=context, parsed=None)
    assert step.around is not None
    asyncio.run(step.around(call, proceed))


PLACES: dict[str, Callable[[str, Path], None]] = {
    one.__name__: one
    for one in (
        *(estop_status, refused_by_latch, status, module_report, maintenance),
        *(damaged_maintenance, error, file_error, unexpected_error, log_line, on_the_page),
        *(event, alarm, tightened, plugins_list, plugins_verbose, plugins_show, runs_list),
        *(ros_list, link_status, approval),
    )
}


SEVERAL_LINES = {"plugins_list", "plugins_verbose", "plugins_show"}


@pytest.mark.parametrize("kind", HOSTILE)
@pytest.mark.parametrize("place", PLACES)
def test_text_cannot_control_what_a_person_sees(
    place: str, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    PLACES[place](HOSTILE[kind], tmp_path)
    shown = "".join(capsys.readouterr()).replace(str(tmp_path), "")
    assert shown
    assert is_safe(shown, lines=60 if place in SEVERAL_LINES else 1)
    assert not [
        one for one in shown.splitlines() if one.lstrip().startswith("The emergency stop is not")
    ]


@pytest.mark.parametrize("kind", HOSTILE)
def test_the_person_who_releases_a_stop_sees_whose_words_they_are(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr("builtins.input", lambda question: "n")
    estop_reset(HOSTILE[kind], tmp_path)
    shown = capsys.readouterr().out
    assert is_safe(shown, lines=4)
    first, second, *_ = shown.splitlines()
    assert first.startswith("Latched by ")
    # the reason is between quotation marks, and cannot close them
    assert first.count('"') == 2
    assert "quotation marks" in second


@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE)
def test_printable_text_is_one_bounded_line_and_printing_it_again_changes_nothing(
    text: str,
) -> None:
    shown = printable(text)
    assert is_safe(shown)
    assert len(shown) <= 300
    assert printable(shown) == shown


@pytest.mark.parametrize(
    "text", ["", "Jürgen", "抓住红色方块", "ピック", "a b", "x = 0.3 m ± 1 °", "😀"]
)
def test_ordinary_text_stays_as_it_is(text: str) -> None:
    assert printable(text) == text
    assert quoted(text) == f'"{text}"'


def test_a_report_of_any_node_is_bounded() -> None:
    values = {f"k{'x' * 500}{i}": "y" * 5000 for i in range(1000)} | {"state": "active"}
    told = Report.from_values(values)
    assert len(json.dumps(told.model_dump())) < 20_000
    assert sum(map(len, told.metrics.values())) <= 6000


def ended(question: str = "", stream: object = None) -> str:
    raise EOFError


@pytest.mark.parametrize("command", ["estop --reset", "estop --set-pin", "maintenance --end"])
def test_a_prompt_whose_input_ends_changes_nothing_and_says_so(
    command: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pressed("test", tmp_path)
    MaintenanceFile(tmp_path).begin("a", "admin", "b", AuditLog.in_directory(tmp_path))
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr("builtins.input", ended)
    monkeypatch.setattr("getpass.getpass", ended)
    name, option = command.split()
    try:
        status = run(
            Maintenance() if name == "maintenance" else estop, "--state", str(tmp_path), option
        )
    except RefusedError as error:
        status = terminal.show_error(error)
    assert status != 0
    assert "unexpected" not in "".join(capsys.readouterr())
    assert EmergencyStopLatch.in_directory(tmp_path).is_latched()
    assert MaintenanceFile(tmp_path).read() is not None
    assert not ReleasePin(tmp_path).is_set

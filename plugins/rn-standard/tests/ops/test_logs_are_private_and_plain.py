"""Logs are not for everybody on the machine, and nothing that a client sends acts on the terminal
that shows them.
"""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from rn_standard.ops.incidents import Incidents
from rn_standard.ops.records import parse_entries
from rn_standard.ops.server_log import ServerLog
from roboneuron.gate.audit import AuditLog, AuditRecord
from roboneuron.log_files import PlainFormatter, escaped
from roboneuron.supervisor.process import ProcessEvents, spawn

FORGED = "x\n2026-01-01 00:00:00,000 INFO roboneuron.gate: allowed"


@pytest.fixture(autouse=True)
def _usual_umask() -> Iterator[None]:
    before = os.umask(0o022)
    yield
    os.umask(before)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_files_are_640_and_directories_750(tmp_path: Path) -> None:
    state = tmp_path / "state"
    log = ServerLog(state / "log" / "run")
    log.open()
    logging.getLogger("t").warning("x")
    log.close()
    process = spawn(
        "m", ["true"], dict(os.environ), "", state / "log" / "run" / "m.log", ProcessEvents()
    )
    process.reap(lambda _: None)
    assert process.wait(20)
    process.note("said")
    incident = Incidents(state / "incidents").record("robot", "silent", {})
    assert incident is not None
    audit = AuditLog(state / "audit.jsonl", lambda: 1)
    audit.write(AuditRecord(who="a", role="admin", tool="t", verdict="allowed"))
    audit.close()
    files = [path for path in state.rglob("*") if path.is_file()]
    assert len(files) >= 4
    assert {mode(path) for path in files} == {0o640}
    assert {
        mode(path) for path in (state, state / "log", log.path.parent, state / "incidents")
    } == {0o750}


def test_a_note_stands_among_the_last_lines_and_passes_for_one_entry(tmp_path: Path) -> None:
    path = tmp_path / "log" / "m.log"
    path.parent.mkdir()
    process = spawn("m", ["echo", "up"], dict(os.environ), "", path, ProcessEvents())
    process.reap(lambda _: None)
    assert process.wait(20)
    process.note("killed\nERROR \x1b[2Jé")
    assert process.last_lines() == ("up", "killed", "    ERROR \\x1b[2Jé")
    path.unlink()
    process.note("again")
    assert path.stat().st_mode & 0o007 == 0
    path.unlink()
    path.parent.rmdir()
    process.note("nowhere to write it")


@pytest.mark.parametrize(
    "text", ["\x1b[31mred", "a\rb", "a\0b", "a\x9bm", "\u202egnp.exe", "a\u2028b", "\ud800", "\x07"]
)
def test_control_characters_are_shown_not_sent(text: str) -> None:
    shown = escaped(text)
    assert "\\" in shown
    assert all(c.isprintable() for c in shown)


def test_a_client_cannot_forge_an_entry() -> None:
    formatter = PlainFormatter()
    lines = formatter.format(
        logging.LogRecord("t", 20, "f", 1, "Refused %s", (FORGED,), None)
    ).splitlines()
    (entry,) = parse_entries(tuple(lines))
    assert "allowed" in entry.text
    try:
        raise ValueError(FORGED + "\x1b[2J")
    except ValueError as error:
        record = logging.LogRecord(
            "t", 40, "f", 1, "failed", (), (ValueError, error, error.__traceback__)
        )
    text = formatter.format(record)
    assert "Traceback" in text
    assert "\x1b" not in text
    assert len(parse_entries(tuple(text.splitlines()))) == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_costs_the_log_and_is_reported_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "server.log").symlink_to("/dev/full")
    log = ServerLog(tmp_path)
    log.open()
    try:
        for number in range(3):
            logging.getLogger("t").warning("%d", number)
    finally:
        log.close()
    told = [one for one in caplog.records if one.name == "rn_standard.ops.server_log"]
    assert [one.levelname for one in told] == ["ERROR"]
    assert "No space left" in told[0].getMessage()
    assert [one.getMessage() for one in caplog.records if one.name == "t"] == ["0", "1", "2"]

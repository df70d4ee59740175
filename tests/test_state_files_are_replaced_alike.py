"""Every state file is replaced as a whole, on the disk before it has its name, and private."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from rn_standard.ops.maintenance import MaintenanceFile
from rn_view.diagnostics.alarms import AlarmBook
from roboneuron import RefusedError, foreign
from roboneuron.estop.pin import ReleasePin
from roboneuron.gate import AuditLog
from roboneuron.tools.arm.tightening import FILE_NAME as TIGHTENED
from roboneuron.tools.arm.tightening import TightenedRecord, Tightening, TighteningFile


def pin(folder: Path) -> None:
    ReleasePin(folder, clock_s=lambda: 0.0).set("1234")


def maintenance(folder: Path) -> None:
    with closing(AuditLog.in_directory(folder / "audit")) as audit:
        MaintenanceFile(folder).begin("me", "operator", "", audit)


def tightening(folder: Path) -> None:
    record = TightenedRecord(tightening=Tightening(max_speed_m_s=0.1), who="me", at_ns=1)
    TighteningFile(folder / TIGHTENED).write(record)


def alarms(folder: Path) -> None:
    with closing(AuditLog.in_directory(folder / "audit")) as audit:
        book = AlarmBook(folder, audit)
        book.add("server", "one", "", "")
        book.save()


WRITERS: dict[str, Callable[[Path], None]] = {
    "PIN": pin,
    "maintenance": maintenance,
    "tightened limits": tightening,
    "alarms": alarms,
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_state_file_is_on_the_disk_before_it_has_its_name(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a loss of power a file renamed before its content was written would be empty."""
    synced: list[str] = []
    sync = os.fsync

    def note(descriptor: int) -> None:
        synced.append(os.readlink(f"/proc/self/fd/{descriptor}"))
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", note)
    WRITERS[name](tmp_path)
    files = [path for path in tmp_path.iterdir() if path.is_file() and path.suffix != ".lock"]
    (made,) = files
    assert any(Path(path).name.startswith(f".{made.name}.") for path in synced)
    assert stat.S_IMODE(made.stat().st_mode) == 0o600


@pytest.mark.parametrize("umask", [0, 0o022])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    umask: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "new folder" / "state.json"
    before = os.umask(umask)
    try:
        foreign.write_private(path, "old")
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        foreign.write_private(path, "new")
    assert [one.read_text() for one in path.parent.iterdir()] == ["old"]


def test_limits_that_cannot_be_kept_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    record = TightenedRecord(tightening=Tightening(max_speed_m_s=0.1), who="me", at_ns=1)
    with pytest.raises(RefusedError):
        TighteningFile(tmp_path / "file" / TIGHTENED).write(record)

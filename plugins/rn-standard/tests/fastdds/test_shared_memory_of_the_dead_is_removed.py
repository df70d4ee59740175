"""What killed processes leave in shared memory, and whose it is: only what nobody holds any more is
removed.
"""

from __future__ import annotations

import fcntl
import mmap
import os
from pathlib import Path

import pytest

from rn_standard.fastdds import shared_memory
from rn_standard.fastdds.shared_memory import clean_abandoned

AGE_S = 3600.0


def segment(directory: Path, name: str, *, age_s: float = AGE_S) -> Path:
    """A segment with its lock file, as Fast DDS makes them."""
    path = directory / f"fastrtps_{name}"
    path.write_bytes(b"x" * 1000)
    lock = directory / f"fastrtps_{name}_el"
    lock.touch()
    written_s = lock.stat().st_mtime - age_s
    os.utime(lock, (written_s, written_s))
    return path


def test_only_old_segments_that_nobody_locks_or_maps_are_removed(tmp_path: Path) -> None:
    dead = segment(tmp_path, "0123456789abcdef")
    locked = segment(tmp_path, "1123456789abcdef")
    mapped = segment(tmp_path, "2123456789abcdef")
    young = segment(tmp_path, "3123456789abcdef", age_s=0.0)
    port = segment(tmp_path, "port7412")
    (tmp_path / "sem.fastrtps_port7412_mutex").touch()
    unlocked = segment(tmp_path, "port7413")
    os.utime(unlocked, (1.0, 1.0))
    Path(f"{unlocked}_el").unlink()
    stranger = tmp_path / "psm_0123456789abcdef"
    stranger.touch()
    with open(f"{locked}_el", "rb") as lock, mapped.open("rb") as file:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ):
            assert clean_abandoned(tmp_path) == (3, 3000)
    assert not dead.exists()
    assert not Path(f"{dead}_el").exists()
    assert not port.exists()
    assert not unlocked.exists()
    assert not (tmp_path / "sem.fastrtps_port7412_mutex").exists()
    assert all(path.exists() for path in (locked, mapped, young, stranger))
    assert clean_abandoned(tmp_path)[0] == 2
    assert young.exists()


def test_no_process_is_looked_at_where_nothing_is_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first call of an agent waits for it."""
    looked: list[Path] = []
    monkeypatch.setattr(shared_memory, "_mapped", lambda where: looked.append(where) or set())
    segment(tmp_path, "0123456789abcdef", age_s=0.0)
    assert clean_abandoned(tmp_path) == (0, 0)
    assert looked == []

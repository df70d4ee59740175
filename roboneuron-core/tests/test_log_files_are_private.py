"""Log files are created with their folders, and are private."""

from __future__ import annotations

from pathlib import Path

import pytest

from roboneuron.log_files import DIRECTORY_MODE, FILE_MODE, opener


def test_a_file_that_is_made_has_private_folders(tmp_path: Path) -> None:
    path = tmp_path / "log" / "run" / "control.log"
    with open(path, "a", encoding="utf-8", opener=opener) as file:
        file.write("begun\n")
    assert path.stat().st_mode & 0o777 & ~FILE_MODE == 0
    assert path.parent.stat().st_mode & 0o777 & ~DIRECTORY_MODE == 0


def test_to_read_makes_no_folder(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), open(tmp_path / "log" / "control.log", opener=opener):
        pass
    assert not (tmp_path / "log").exists()

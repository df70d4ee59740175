"""The command that creates tiny checkpoints, without LeRobot."""

from __future__ import annotations

from pathlib import Path

import pytest

from rn_backend_lerobot.cli import main
from roboneuron.plugins.availability import is_importable


@pytest.mark.skipif(is_importable("lerobot"), reason="LeRobot is installed here")
def test_it_says_that_lerobot_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["make-tiny", str(tmp_path / "act"), "--policy", "act"]) == 2
    said = capsys.readouterr().err
    assert "LeRobot is not installed in" in said
    assert "Python 3.12" in said
    assert not (tmp_path / "act").exists()


def test_it_does_not_write_into_a_folder_that_is_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    assert main(["make-tiny", str(tmp_path)]) == 2
    assert "is not empty" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--policy", "telepathy"], ["--size", "big"]])
def test_it_refuses_what_it_cannot_make(tmp_path: Path, arguments: list[str]) -> None:
    with pytest.raises(SystemExit):
        main(["make-tiny", str(tmp_path / "x"), *arguments])

"""Commands about several robots; no server runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from roboneuron.cli.main import main
from roboneuron.estop import ESTOP_FILE
from roboneuron.tools.arm.tightening import (
    FILE_NAME,
    TightenedRecord,
    Tightening,
    TighteningFile,
)


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """The state directory of a server with two robots that has ended."""
    for name in ("left", "right"):
        (tmp_path / "robots" / name).mkdir(parents=True)
    return tmp_path


def latches(state: Path) -> list[str]:
    return sorted(str(path.parent.relative_to(state)) for path in state.rglob(ESTOP_FILE))


def test_a_stop_in_a_terminal_reaches_all_robots(
    state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["estop", "--state", str(state)]) == 0
    assert latches(state) == [".", "robots/left", "robots/right"]
    assert main(["estop", "--state", str(state), "--status"]) == 1
    assert capsys.readouterr().out.count("is latched by") == 3


def test_a_stop_of_one_robot_in_a_terminal_leaves_the_others(
    state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["estop", "--state", str(state), "--robot", "left"]) == 0
    assert latches(state) == ["robots/left"]
    assert main(["estop", "--state", str(state), "--robot", "right", "--status"]) == 0
    assert main(["estop", "--state", str(state), "--robot", "middle"]) == 2
    assert "there are: left, right" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [("estop",), ("maintenance", "--begin", "repair"), ("maintenance",), ("limits",)],
    ids=" ".join,
)
def test_a_robot_that_does_not_exist_is_named_and_nothing_is_written(
    words: tuple[str, ...], state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(state.rglob("*"))
    assert main([*words, "--state", str(state), "--robot", "lfet"]) == 2
    assert "there are: left, right" in capsys.readouterr().err
    assert sorted(state.rglob("*")) == before


def test_limits_of_a_robot_that_cannot_be_read_hide_no_others(
    state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tightened = TightenedRecord(tightening=Tightening(max_speed_m_s=0.1), who="agent", at_ns=1)
    TighteningFile(state / "robots" / "right" / FILE_NAME).write(tightened)
    (state / "robots" / "left" / FILE_NAME).write_text("{")
    assert main(["limits", "--state", str(state)]) == 1
    shown = capsys.readouterr().out
    assert str(state / "robots" / "left") in shown
    assert '{"max_speed_m_s": 0.1}, by agent' in shown


def test_a_latch_that_cannot_be_written_keeps_no_other_from_being_pressed(state: Path) -> None:
    (state / "robots" / "left").rmdir()
    (state / "robots" / "left").write_text("a file in the place of the folder")
    assert main(["estop", "--state", str(state)]) == 2
    assert latches(state) == [".", "robots/right"]


def test_a_reset_needs_a_person_for_each(
    state: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["estop", "--state", str(state)])
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    answers = iter(["y", "n", "y"])
    monkeypatch.setattr("builtins.input", lambda _: next(answers))
    assert main(["estop", "--state", str(state), "--reset"]) == 1
    assert latches(state) == ["robots/left"]


def test_config_check_names_the_robots_and_what_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "fleet.toml"
    head = f'disabled_plugins = ["rn-recorder"]\n[supervisor]\nstate_directory = "{tmp_path}"\n'
    path.write_text(f'{head}[robots.a]\nrobot = "husky"\n[robots.b-1]\nrobot = "racecar"\n')
    assert main(["config", "check", str(path)]) == 0
    assert "is valid: robots a (husky, /a), b-1 (racecar, /b_1)." in capsys.readouterr().out
    path.write_text(f'{head}[robots.a]\nrobot = "husky"\n[robots.b]\nrobot = "huskie"\n')
    assert main(["config", "check", str(path)]) == 2
    assert "[robots.b]" in capsys.readouterr().err

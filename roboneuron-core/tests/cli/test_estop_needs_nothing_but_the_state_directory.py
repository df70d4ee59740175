"""`roboneuron estop --config FILE` stops the robot whatever is wrong with the file, the plugins or
the robot.
"""

from __future__ import annotations

import getpass
import os
import sys
import time
from pathlib import Path
from typing import NoReturn

import pytest

from roboneuron.cli.main import main
from roboneuron.estop import ESTOP_FILE, EmergencyStopLatch

BROKEN = """
disabled_plugins = ["never-installed"]
[robots.left]
robot = "never-installed"
[a_section_that_no_feature_knows]
key = 1
[supervisor]
unknown = 1
"""


def test_a_configuration_that_no_server_would_take_still_names_the_state_directory(
    tmp_path: Path,
) -> None:
    file, state = tmp_path / "roboneuron.toml", tmp_path / "state"
    file.write_text(f'{BROKEN}state_directory = "{state}"\n')
    assert main(["estop", "--config", str(file), "--reason", "smoke"]) == 0
    assert (state / ESTOP_FILE).exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "[supervisor]\nstate_directory = 3\n",
            "supervisor.state_directory = 3: input should be a valid string",
        ),
        ("[supervisor\n", "is not valid TOML"),
        (None, "There is no file"),
    ],
)
def test_a_file_that_does_not_tell_the_directory_is_refused(
    text: str | None,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "elsewhere"))
    file = tmp_path / "roboneuron.toml"
    if text is not None:
        file.write_text(text)
    assert main(["estop", "--config", str(file)]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.rglob(ESTOP_FILE))


def test_a_stop_without_a_reason_leaves_no_empty_place_for_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["estop", "--state", str(tmp_path)]) == 0
    assert main(["estop", "--state", str(tmp_path), "--status"]) == 1
    assert "at the command line (" in capsys.readouterr().out
    state = EmergencyStopLatch(tmp_path / ESTOP_FILE, time.time_ns).read_state()
    assert state.cause.endswith(" at the command line")


@pytest.mark.parametrize("error", [KeyError, OSError])
def test_a_user_without_a_name_stops_the_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    """A container may run as any number, without an entry in passwd."""

    def nameless() -> NoReturn:
        raise error("getpwuid(): uid not found")

    monkeypatch.setattr(getpass, "getuser", nameless)
    assert main(["estop", "--state", str(tmp_path)]) == 0
    state = EmergencyStopLatch(tmp_path / ESTOP_FILE, time.time_ns).read_state()
    assert state.who == f"user {os.getuid()} at the command line"


def test_a_stop_that_is_pressed_while_the_terminal_asks_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    latch = EmergencyStopLatch(tmp_path / ESTOP_FILE, time.time_ns)
    latch.press(who="ann", reason="smoke")

    def agree(_: str) -> str:
        assert main(["estop", "--state", str(tmp_path), "--reason", "fire"]) == 0
        (tmp_path / ESTOP_FILE).rename(tmp_path / f"{ESTOP_FILE}.reset")
        EmergencyStopLatch(tmp_path / ESTOP_FILE, time.time_ns).press(who="bob", reason="a hand")
        return "y"

    monkeypatch.setattr("builtins.input", agree)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    assert main(["estop", "--state", str(tmp_path), "--reset"]) != 0
    assert "pressed again" in capsys.readouterr().err
    assert latch.read_state().cause == 'bob: "a hand"'

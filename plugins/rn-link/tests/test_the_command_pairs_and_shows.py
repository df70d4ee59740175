"""`roboneuron link`, as typed by a person."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from rn_link.command import check_code, host_name
from rn_testing.waiting import wait_until
from roboneuron import ConfigurationError

PROGRAM = str(Path(sys.executable).with_name("roboneuron"))
PORT = 7420 + os.getpid() % 60


def link(state: Path, *arguments: str, text: str = "") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [PROGRAM, "link", *arguments],
        env={**os.environ, "XDG_STATE_HOME": str(state)},
        input=text,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )


@pytest.mark.exhaustive
def test_two_machines_are_paired_shown_and_parted(tmp_path: Path) -> None:
    robot, gpu = tmp_path / "robot", tmp_path / "gpu"
    assert "no link" in link(robot, "show").stdout
    assert "is the hub robot" in link(robot, "init", "--name", "robot").stdout
    output = tmp_path / "added"
    with output.open("w") as file:
        adding = subprocess.Popen(
            [PROGRAM, "link", "add", "gpu", "--port", str(PORT)],
            env={**os.environ, "XDG_STATE_HOME": str(robot)},
            stdout=file,
        )
    try:
        wait_until(lambda: "Code:" in output.read_text(), 30.0, "the code")
        found = re.search(r"Code: (\d{3} \d{3})", output.read_text())
        assert found is not None
        joined = link(gpu, "init", "--join", f"127.0.0.1:{PORT}", text=f"{found[1]}\n")
        assert "This machine is gpu, a member of robot" in joined.stdout, joined.stderr
        assert adding.wait(10.0) == 0
    finally:
        adding.kill()
        adding.wait(10.0)
    assert "gpu is added: 127.0.0.1, TCP 7411" in output.read_text()
    assert "The machine gpu (127.0.0.1, TCP 7411) is NOT connected" in link(robot, "show").stdout
    again = link(robot, "add", "gpu", "--port", str(PORT))
    assert again.returncode == 2
    assert "paired already" in again.stderr
    refused = link(gpu, "add", "another")
    assert refused.returncode == 2
    assert "Type the command on robot" in refused.stderr
    assert "gpu is removed" in link(robot, "remove", "gpu").stdout
    assert "gpu" not in link(robot, "show").stdout
    assert "removed" in link(gpu, "remove", "--all").stdout
    assert "no link" in link(gpu, "show").stdout


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize(
    ("arguments", "text", "told"),
    [
        (["add", "gpu"], "", "no link"),
        (["run"], "", "No other machine is paired"),
        (["remove", "gpu"], "", "No machine 'gpu' is paired"),
        (["init", "--join", "robot.local"], "1", "not an IPv4 address"),
        (["init", "--join", "10.0.0.1:http"], "123456\n", "'http' is no port"),
        (["init", "--join", "10.0.0.1"], "12\n", "not six digits"),
        (["init", "--join", "10.0.0.1", "--port", "80"], "", "cannot use port 80"),
        (["init", "--name", "My Robot"], "", "not a name"),
    ],
)
def test_a_wrong_input_gets_one_sentence(
    tmp_path: Path, arguments: list[str], text: str, told: str
) -> None:
    found = link(tmp_path, *arguments, text=text)
    assert found.returncode == 2, found
    assert told in found.stderr
    assert "Traceback" not in found.stderr


def test_a_code_may_have_spaces_and_nothing_else() -> None:
    assert check_code(" 123 456\n") == "123456"
    for text in ("", "12345", "1234567", "12345a", "١٢٣٤٥٦"):
        with pytest.raises(ConfigurationError, match="six digits"):
            check_code(text)


def test_a_host_name_is_put_into_form(monkeypatch: pytest.MonkeyPatch) -> None:
    for found, expected in {"Lab_PC.local": "lab-pc-local", "...": "robot"}.items():
        monkeypatch.setattr("socket.gethostname", lambda found=found: found)
        assert host_name() == expected


def test_a_key_that_others_may_use_is_named(tmp_path: Path) -> None:
    assert link(tmp_path, "init", "--name", "robot").returncode == 0
    assert not link(tmp_path, "show").stderr
    key = tmp_path / "roboneuron" / "link" / "own.key"
    key.chmod(0o640)
    assert f"chmod go= {key}" in link(tmp_path, "show").stderr

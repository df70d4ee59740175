"""Files for a service manager and a container builder, as far as they can be tested."""

from __future__ import annotations

import configparser
import json
import re
import shlex
import shutil
import socket
import subprocess
import sys
from argparse import ArgumentParser
from pathlib import Path

import pytest
from policy_servers import RunningServer

from rn_backend_openpi.serve_command import ServePolicyCommand, deployment_file
from rn_backend_openpi.server_options import ListenOptions
from rn_testing.waiting import wait_until
from roboneuron.cli.main import main

ROOT = Path(__file__).parents[3]


def command_of(words: list[str]) -> str:
    """The configuration named in this command line of `policy serve`."""
    parser = ArgumentParser()
    ServePolicyCommand().configure(parser)
    given = parser.parse_args(words)
    assert given.action == "run"
    return str(given.config)


@pytest.mark.parametrize("name", ["policies.toml", "with space and 100%.toml"])
def test_the_unit_runs_this_interpreter_with_that_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    config = tmp_path / name
    assert main(["policy", "serve", "unit", "--config", str(config)]) == 0
    unit = configparser.ConfigParser(interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read_string(capsys.readouterr().out)
    words = [word.replace("%%", "%") for word in shlex.split(unit["Service"]["ExecStart"])]
    assert words[:5] == [sys.executable, "-m", "roboneuron.cli.main", "policy", "serve"]
    assert command_of(words[5:]) == str(config)
    assert unit["Service"]["Type"] == "notify"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
@pytest.mark.parametrize("type_", ["notify", "nothing"])
def test_systemd_accepts_the_unit_and_looks_at_what_is_written_there(
    tmp_path: Path, type_: str
) -> None:
    path = tmp_path / "roboneuron-policies.service"
    unit = deployment_file("unit", tmp_path / "with space and 100%.toml")
    path.write_text(unit.replace("Type=notify", f"Type={type_}"))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--user", str(path)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env={"PATH": "/usr/bin:/bin", "XDG_RUNTIME_DIR": str(tmp_path), "HOME": str(tmp_path)},
    )
    is_named = "roboneuron-policies" in done.stdout + done.stderr
    assert is_named == (type_ == "nothing")


@pytest.mark.timeout(200)
def test_a_server_tells_its_manager_that_it_has_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(60.0)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        listen = {"keys": "token", "token_file": str(tmp_path / "token")}
        server = RunningServer(tmp_path, {"only": {}}, listen)
        try:
            server.start(is_ready=False)
            assert manager.recv(100) == b"READY=1"
            assert server.end() == 0
        finally:
            server.end()
    wait_until(lambda: not list(server.run.glob("*.sock")), 30.0, "no socket is left")


def test_the_container_file_installs_and_runs_what_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["policy", "serve", "containerfile"]) == 0
    text = re.sub(r"(?m)^#.*\n", "", capsys.readouterr().out).replace("\\\n", " ")
    steps = [line.partition(" ") for line in text.splitlines() if line]
    assert steps[0][0] == "FROM"
    by_name = {name: rest for name, _, rest in steps}
    entry = json.loads(by_name["ENTRYPOINT"])
    assert entry[:3] == ["roboneuron", "policy", "serve"]
    assert command_of(entry[3:]) == "/etc/policies.toml"
    assert int(by_name["EXPOSE"]) == ListenOptions().port
    assert by_name["USER"] != "0"
    # its script with a pip that prints its arguments, and wheels with RoboNeuron's names
    script, folder = (
        next(rest for name, _, rest in steps if name == "RUN" and "pip" in rest),
        tmp_path,
    )
    names = ("roboneuron_core", "rn_link", "rn_vla", "rn_backend_openpi", "rn_backend_oft")
    (folder / "wheels").mkdir()
    for name in (*names, "rn_eval"):
        assert (ROOT / "plugins" / name.replace("_", "-")).exists() or name == "roboneuron_core"
        (folder / "wheels" / f"{name}-0.1.0-py3-none-any.whl").touch()
    pip = folder / "pip"
    pip.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    pip.chmod(0o755)
    done = subprocess.run(
        ["sh", "-c", script.replace("/wheels", str(folder / "wheels"))],
        env={
            "PATH": f"{folder}:/usr/bin:/bin",
            "BACKENDS": "rn_backend_oft",
            "PACKAGES": "torch",
        },
        capture_output=True,
        text=True,
        timeout=30,
        check=True,
    )
    wheels = [str(folder / "wheels" / f"{name}-0.1.0-py3-none-any.whl") for name in names]
    assert done.stdout.split() == ["install", "--no-cache-dir", "torch", *wheels]


def test_a_folder_that_no_socket_fits_into_is_named_before_anything_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, folder = tmp_path / "policies.toml", tmp_path / ("x" * 90)
    listen = {"keys": "token", "token_file": str(tmp_path / "token"), "directory": str(folder)}
    table = ", ".join(f"{key} = {json.dumps(value)}" for key, value in listen.items())
    config.write_text(f"listen = {{ {table}, port = 0 }}\n[models.only]\nbackend = 'reflex'\n")
    assert main(["policy", "serve", "--config", str(config)]) == 2
    said = capsys.readouterr().err
    assert "too long for a socket" in said
    assert "`directory` under [listen]" in said

"""What `serve` and `estop` say to a person at a real terminal."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest

from roboneuron.cli.main import main
from roboneuron.estop import ESTOP_FILE, EmergencyStopLatch

SERVE = [sys.executable, "-m", "roboneuron.cli.main", "serve"]
CONFIG = """[robot]
name = "none"
[supervisor]
state_directory = "{state}"
"""


def read_until(descriptor: int, words: str, limit_s: float) -> str:
    text, deadline_s = "", time.monotonic() + limit_s
    while words not in text:
        assert time.monotonic() < deadline_s, text
        if select.select([descriptor], [], [], 0.1)[0]:
            try:
                text += os.read(descriptor, 4096).decode()
            except OSError:  # Linux: the terminal's other end is closed
                break
    return text


def test_serve_at_a_terminal_says_that_it_waits_for_a_client(tmp_path: Path) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(CONFIG.format(state=tmp_path / "state"))
    person, terminal = pty.openpty()
    server = subprocess.Popen(
        [*SERVE, "--config", str(config)], stdin=terminal, stdout=terminal, stderr=terminal
    )
    os.close(terminal)
    try:
        text = " ".join(read_until(person, "Ctrl-C ends it.", 60.0).split())
        assert "waits for an MCP client on standard input, which is this terminal" in text
        assert "roboneuron run" in text
    finally:
        server.kill()
        server.wait()
        os.close(person)


def test_serve_for_a_client_does_not_say_so(tmp_path: Path) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(CONFIG.format(state=tmp_path / "state"))
    done = subprocess.run(
        [*SERVE, "--config", str(config)], input=b"", capture_output=True, timeout=120, check=False
    )
    assert b"this terminal" not in done.stderr
    assert done.stdout == b""


def test_a_stop_without_a_reason_leaves_no_empty_place_for_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["estop", "--state", str(tmp_path)]) == 0
    assert main(["estop", "--state", str(tmp_path), "--status"]) == 1
    assert "at the command line (" in capsys.readouterr().out
    state = EmergencyStopLatch(tmp_path / ESTOP_FILE, time.time_ns).read_state()
    assert state.cause.endswith(" at the command line")

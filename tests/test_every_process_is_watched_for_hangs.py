"""Every process that serves, moves, records or shows a robot watches itself for hangs of its
interpreter: it handles the signal that would end it (bit of SigCgt in proc(5)).
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from rn_testing.waiting import wait_until
from roboneuron.answering_process import COMMAND
from roboneuron.hang_watch import END_SIGNAL

pytestmark = pytest.mark.timeout(120)
SOON_S = 60.0
PROGRAM = ["-m", "roboneuron.cli.main"]
COMMANDS = {
    "module": ["-m", "roboneuron.modules"],
    "recorder": ["-m", "rn_recorder_runs.node"],
    "answering": [*COMMAND[1:], "DESCRIPTOR"],
    "server": [*PROGRAM, "serve", "--config", "CONFIG"],
    "view": [*PROGRAM, "view", "--config", "CONFIG", "--port", "0"],
    "policy model": ["-m", "rn_backend_openpi.server_process", "--stay", "SOCKET"],
    "policy front": [*PROGRAM, "serve-policy", "--config", "POLICIES"],
}
DEFAULT = ("module", "recorder", "answering", "server")


def is_watched(pid: int) -> bool:
    status = Path(f"/proc/{pid}/status").read_text()
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught.split()[1], 16) >> (END_SIGNAL - 1) & 1)


@pytest.mark.parametrize(
    "name",
    [
        name if name in DEFAULT else pytest.param(name, marks=pytest.mark.exhaustive)
        for name in COMMANDS
    ],
)
def test_it_handles_the_signal_of_its_watch(name: str, tmp_path: Path) -> None:
    (tmp_path / "roboneuron.toml").write_text(
        f'[robot]\nname = "fr3"\n[supervisor]\nstate_directory = "{tmp_path}/state"\n'
    )
    (tmp_path / "policies.toml").write_text(
        f'[listen]\nport = 0\ndirectory = "{tmp_path}/policy"\n[models.servo]\nbackend = "servo"\n'
    )
    own, theirs = socket.socketpair()
    words = {
        "CONFIG": str(tmp_path / "roboneuron.toml"),
        "POLICIES": str(tmp_path / "policies.toml"),
        "SOCKET": str(tmp_path / "model.sock"),
        "DESCRIPTOR": str(theirs.fileno()),
    }
    with own, theirs:
        child = subprocess.Popen(
            [sys.executable, "-P", *(words.get(word, word) for word in COMMANDS[name])],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "XDG_STATE_HOME": str(tmp_path)},
            pass_fds=(theirs.fileno(),),
        )
    with child:
        try:
            assert child.stdin is not None
            if name == "policy model":
                child.stdin.write(b'{"backend": "servo"}\n')
                child.stdin.flush()
            wait_until(
                lambda: child.poll() is None and is_watched(child.pid), SOON_S, "it is not watched"
            )
        finally:
            child.kill()


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(400)
def test_the_command_line_stops_the_arm_of_a_server_that_hangs(tmp_path: Path) -> None:
    """SIGUSR1 does not; benchmarks/hang_matrix.py judges the time."""
    benchmark = Path(__file__).parents[1] / "benchmarks" / "hang_matrix.py"
    chosen = ["--processes", "server", "--phases", "motion", "--told", "estop"]
    command = [sys.executable, str(benchmark), "--folder", str(tmp_path), *chosen]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr

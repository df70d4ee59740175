"""The commands run, status and logs as used by a person, with the simulated arm, the servo backend,
and real processes.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from rn_testing.domain import free_ros_domain
from rn_testing.waiting import wait_for_line, wait_until

pytestmark = [pytest.mark.ros, pytest.mark.timeout(300)]
ROBONEURON = [sys.executable, "-P", "-m", "roboneuron.cli.main"]


def roboneuron(environment: dict[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*ROBONEURON, *words],
        env=environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


@contextmanager
def going_on(environment: dict[str, str], *words: str) -> Iterator[subprocess.Popen[str]]:
    """Run the command in the background; interrupt it at the end, as with Ctrl-C."""
    with subprocess.Popen(
        [*ROBONEURON, *words],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                process.wait(timeout=60)


def modules_of(server: int) -> list[int]:
    """Process ids of a server and its children."""
    listed = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(server)], capture_output=True, text=True, check=False
    )
    return [int(word) for word in listed.stdout.split()]


@pytest.mark.exhaustive  # the run that is interrupted starts and stops the same
def test_an_instruction_is_run_and_everything_is_stopped(environment: dict[str, str]) -> None:
    done = roboneuron({**environment, "PYTHONIOENCODING": "ascii"}, "run", "pick up the red cube")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    starts = [line.split()[2] for line in lines if " + start " in line]
    assert starts == ["robot", "perception", "control"]
    assert any("stop inference, control, perception, robot" in line for line in lines)
    assert lines[-1].startswith("succeeded: ")
    assert done.stdout.isascii()
    left = roboneuron(environment, "status", "--json")
    assert left.returncode == 1
    assert json.loads(left.stdout)[0]["modules"] == []


@pytest.mark.parametrize(
    ("words", "status", "reason"),
    [
        # the demo refuses it too, see test_commands_end_in_one_line.py
        pytest.param(("make me a coffee",), 1, "'make me a coffee'", marks=pytest.mark.slow),
        pytest.param(
            ("pick up the red cube", "--max-s", "0.5", "--max-attempts", "1"),
            1,
            "timed_out: 0.5 s are over",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_run_that_comes_to_nothing_says_so(
    environment: dict[str, str], words: tuple[str, ...], status: int, reason: str
) -> None:
    done = roboneuron(environment, "run", "-q", *words)
    assert done.returncode == status
    (line,) = [
        line
        for line in (done.stdout + done.stderr).splitlines()
        if "coffee" in line or "timed_out" in line
    ]
    assert reason in line


def test_an_interrupted_run_stops_everything(environment: dict[str, str]) -> None:
    with going_on(environment, "run", "pick up the red cube") as process:
        wait_for_line(process.stdout, "start robot")
        server = modules_of(process.pid)
        assert server
        process.send_signal(signal.SIGINT)
        assert process.stdout is not None
        rest = process.stdout.read()
        assert process.wait(timeout=60) == 130
    assert "robot" in next(line for line in rest.splitlines() if " stop " in line)
    assert rest.splitlines()[-1] == "interrupted, stopped"
    assert not any(Path(f"/proc/{pid}").exists() for pid in server)


@pytest.mark.exhaustive
def test_status_and_logs_show_what_a_kept_server_runs(environment: dict[str, str]) -> None:
    with going_on(environment, "call", "start_robot", "--then", "get_status", "--keep") as process:
        wait_for_line(process.stderr, "running until Ctrl-C: the server of this command, robot")
        shown = roboneuron(environment, "status", "--json")
        assert shown.returncode == 0, shown.stdout + shown.stderr
        (status,) = json.loads(shown.stdout)
        assert [module["module"] for module in status["modules"]] == ["robot"]
        assert status["namespace"] == "fr3"
        assert os.path.basename(status["log_directory"]).endswith(f"-{status['pid']}")
        table = roboneuron(environment, "status").stdout
        assert f"server pid {status['pid']}" in table
        elsewhere = {**environment, "ROS_DOMAIN_ID": str(free_ros_domain())}
        other = roboneuron(elsewhere, "status")
        assert other.returncode == 1
        assert f"ROS_DOMAIN_ID={environment['ROS_DOMAIN_ID']} roboneuron status" in other.stdout
        # the server looks at its modules by itself, a little later
        wait_until(
            lambda: "robot: ok (was starting)" in roboneuron(environment, "logs", "server").stdout,
            60.0,
        )
        with going_on(environment, "logs", "--follow", "-n", "1") as follower:
            assert follower.stdout is not None
            assert status["log_directory"] in follower.stdout.readline()
            process.send_signal(signal.SIGINT)
            bound = threading.Timer(60, follower.kill)  # readline has no timeout
            bound.start()
            assert any("Stopped robot: pid" in line for line in iter(follower.stdout.readline, ""))
            bound.cancel()
        assert process.wait(timeout=60) == 0
        assert process.stderr is not None
        assert "ending the server of this command, robot." in process.stderr.read()

"""Models and policy servers that die, hang or cannot be loaded, and their restart."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import pytest
from policy_servers import (
    SEEN,
    Robot,
    Serve,
    answers,
)

from rn_testing.waiting import wait_until
from roboneuron import (
    CheckpointError,
    ConfigurationError,
    NotReadyError,
)
from roboneuron.cli.main import main

pytestmark = pytest.mark.timeout(200)
SLACK_S = 6.0
"""Margin for scheduling on a busy machine; without a deadline a robot would wait forever."""


def test_a_model_that_dies_is_an_error_at_once_and_comes_back(serve: Serve, robot: Robot) -> None:
    server = serve({"slow": {"options": {"took_s": 20.0}}, "quick": {}})
    with pytest.raises(ConfigurationError, match="Name one with `model`: slow, quick"):
        robot(server.address)
    with pytest.raises(ConfigurationError, match="no model 'other'"):
        robot(server.address, model="other")
    slow = robot(server.address, model="slow", timeout_s=30.0)
    quick = robot(server.address, model="quick")
    before = server.status()["models"]
    took_s: list[float] = []

    def ask() -> None:
        begun_s = time.monotonic()
        with pytest.raises(NotReadyError, match="'slow' has died"):
            slow.predict(SEEN)
        took_s.append(time.monotonic() - begun_s)

    waiting = threading.Thread(target=ask)
    waiting.start()
    wait_until(lambda: server.status()["models"]["slow"]["busy_s"] > 0.0, 20.0, "it computes")
    os.kill(before["slow"]["pid"], signal.SIGKILL)
    waiting.join(20.0)
    assert took_s[0] < 15.0
    assert answers(quick), "the other model goes on"
    wait_until(
        lambda: server.status()["models"]["slow"]["restarts"] == 1 and server.is_ready(),
        60.0,
        "it is started again",
    )
    after = server.status()["models"]
    assert after["slow"]["lost"] == 1
    assert after["quick"]["restarts"] == 0
    assert after["quick"]["pid"] == before["quick"]["pid"]


def test_a_model_that_hangs_costs_no_more_than_the_deadline(serve: Serve, robot: Robot) -> None:
    server = serve()
    one = robot(server.address, timeout_s=0.3)
    wait_until(lambda: answers(one), 60.0, "it answers")
    pid = server.status()["models"]["only"]["pid"]
    os.kill(pid, signal.SIGSTOP)
    stat = Path(f"/proc/{pid}/stat")
    wait_until(lambda: stat.read_text().rpartition(")")[2].split()[0] == "T", 20.0, "it stands")
    try:
        begun_s = time.monotonic()
        for _ in range(5):
            with pytest.raises(NotReadyError):
                one.predict(SEEN)
        assert time.monotonic() - begun_s < 5 * 0.3 + SLACK_S
    finally:
        os.kill(pid, signal.SIGCONT)
    wait_until(lambda: answers(one), 60.0, "it goes on")


@pytest.mark.parametrize("how", ["killed", "frozen"])
@pytest.mark.sampled(every=2)
def test_a_server_that_goes_is_found_again_and_nobody_waits_beyond_a_deadline(
    serve: Serve, robot: Robot, how: str
) -> None:
    server = serve()
    one = robot(server.address, timeout_s=0.4)
    wait_until(lambda: answers(one), 60.0, "it answers")
    port, longest_s = server.port, 0.0
    if how == "killed":
        server.kill()
    else:
        os.kill(server.pid, signal.SIGSTOP)
    for _ in range(5):
        begun_s = time.monotonic()
        assert not answers(one)
        longest_s = max(longest_s, time.monotonic() - begun_s)
    assert longest_s < 0.4 + SLACK_S, "a robot has waited beyond its deadline"
    if how == "killed":
        server.start("--port", str(port))
    else:
        os.kill(server.pid, signal.SIGCONT)
    wait_until(lambda: answers(one), 60.0, "the robot is back by itself")


@pytest.mark.exhaustive
def test_why_a_model_cannot_be_loaded_is_told_to_robots_and_in_the_status(
    serve: Serve, robot: Robot, capsys: pytest.CaptureFixture[str]
) -> None:
    server = serve({"bad": {"options": {"fails": True}}, "good": {}}, is_ready=False)
    wait_until(lambda: server.status()["models"]["bad"]["state"] == "failed", 60.0, "it fails")
    with pytest.raises(CheckpointError, match=r"There are no weights\. Copy some"):
        robot(server.address, model="bad")
    wait_until(lambda: server.status()["models"]["good"]["state"] == "ready", 60.0)
    good = robot(server.address, model="good", coding="raw")
    for _ in range(3):
        good.predict(SEEN)
    words = ["serve-policy", "status", "--config", str(server.config)]
    assert main(words) == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown[1].split()[:5] == ["model", "state", "pid", "robots", "batches"]
    row = next(line for line in shown if line.startswith("good")).split()
    assert row[1] == "ready"
    assert row[3:5] == ["1", "3"]
    assert "bad: There are no weights." in shown
    assert main([*words, "--json"]) == 0
    assert '"answered": 3' in capsys.readouterr().out
    assert server.end() == 0
    assert main(words) != 0
    assert "No policy server" in capsys.readouterr().err


@pytest.mark.exhaustive
def test_a_server_that_ends_ends_its_models_even_when_it_is_killed(serve: Serve) -> None:
    server = serve({"a": {}, "b": {}})
    pids = [model["pid"] for model in server.status()["models"].values()]
    server.kill()
    wait_until(lambda: not any(Path(f"/proc/{pid}/exe").exists() for pid in pids), 60.0)

"""Models and policy servers that die, hang or cannot be loaded, and their restart."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import pytest
from policy_servers import SEEN, Robot, Serve, answers, servers_in

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


@pytest.mark.parametrize("how", ["model frozen", "killed", "frozen"])
@pytest.mark.sampled(every=3)
def test_what_hangs_or_goes_is_found_again_and_nobody_waits_beyond_a_deadline(
    serve: Serve, robot: Robot, how: str
) -> None:
    server = serve()
    one = robot(server.address, timeout_s=0.4)
    wait_until(lambda: answers(one), 60.0, "it answers")
    port, longest_s = server.port, 0.0
    pid = server.status()["models"]["only"]["pid"] if how == "model frozen" else server.pid
    if how == "killed":
        server.kill()
    else:
        os.kill(pid, signal.SIGSTOP)
        stat = Path(f"/proc/{pid}/stat")
        wait_until(lambda: ") T" in stat.read_text(), 20.0, "it stands")
    try:
        for _ in range(5):
            begun_s = time.monotonic()
            assert not answers(one)
            longest_s = max(longest_s, time.monotonic() - begun_s)
    finally:
        if how != "killed":
            os.kill(pid, signal.SIGCONT)
    assert longest_s < 0.4 + SLACK_S, "a robot has waited beyond its deadline"
    if how == "killed":
        server.start("--port", str(port))
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
    words = ["policy", "serve", "status", "--config", str(server.config)]
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


def test_a_server_that_dies_is_a_clear_error_and_then_there_is_another(
    spawned: Robot, tmp_path: Path
) -> None:
    one, other = spawned(), spawned()
    (pid,) = servers_in(tmp_path)
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(NotReadyError, match="policy server"):
        one.predict(SEEN)
    wait_until(lambda: answers(one), 90.0, "another server answers")
    wait_until(lambda: answers(other), 90.0, "the other robot has found it too")
    wait_until(lambda: len(servers_in(tmp_path)) == 1, 90.0, "there is one of them")
    assert servers_in(tmp_path) != [pid]


@pytest.mark.parametrize("python", ["/bin/false", "/no/python"])
def test_an_interpreter_that_runs_no_server_is_one_clear_error(spawned: Robot, python: str) -> None:
    with pytest.raises(ConfigurationError, match="server of the shared model"):
        spawned(python=python)


def test_why_a_model_cannot_be_loaded_is_told_as_its_backend_says_it(served: Robot) -> None:
    with pytest.raises(CheckpointError, match=r"There are no weights\. Copy some"):
        served(options={"fails": True})
    with pytest.raises(ConfigurationError, match="'absent'"):
        served(backend="absent")


@pytest.mark.exhaustive
def test_a_server_without_robots_ends_and_leaves_no_socket(spawned: Robot, tmp_path: Path) -> None:
    one = spawned(idle_s=1.0)
    assert answers(one)
    one.close()
    wait_until(lambda: not servers_in(tmp_path), 90.0, "it ends")
    assert list((tmp_path / "run").glob("*.sock")) == []

"""In stepped time the same seed gives the same episode, whatever the machine does meanwhile."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from rn_eval.agents import run
from rn_eval.agents.client import CALL_TIMEOUT, ToolClient
from rn_eval.agents.configuration import configuration_of
from rn_eval.agents.offers import TASKS
from rn_eval.agents.record import AgentPlan, AgentRecord
from rn_eval.agents.task import AgentScene
from rn_eval.ledger import read_records_of
from rn_testing.domain import free_ros_domain
from roboneuron import ConfigurationError
from roboneuron.config import parse_config
from roboneuron.plugins.discovery import discover

NICENESS = "RAY_worker_niceness"
BUSY = "while True: pass"
TASKS_OF_EACH_KIND = "look-table,move-by,move-joint,put-by"


def evaluate(folder: Path, *options: str) -> dict[str, AgentRecord]:
    """Records by task."""
    command = [sys.executable, "-m", "roboneuron.cli.main", "eval", "agents", "--time", "stepped"]
    subprocess.run(
        [*command, "--out", str(folder), *options],
        env={k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")},
        timeout=800,
        check=True,
    )
    return {record.key.task: record for record in read_records_of(folder, AgentRecord)}


def test_only_a_stepped_cell_waits_for_commands(tmp_path: Path):
    scene = AgentScene(seed=3, instruction="Move.")
    real = tomllib.loads(configuration_of(scene, tmp_path))
    stepped = tomllib.loads(configuration_of(scene, tmp_path, "stepped"))
    assert "stepped" not in real["plugins"]["fr3"]
    assert "action_timeout_s" not in real["control"]
    assert stepped["plugins"]["fr3"]["stepped"] is True
    for section in ("robot", "control"):  # a busy machine freezes servers for seconds
        assert "server_timeout_s" not in real[section]
        assert stepped[section]["server_timeout_s"] == 30.0
    assert "start_timeout_s" not in real["supervisor"]
    assert stepped["supervisor"]["start_timeout_s"] == 200.0  # seen: 60 s at a load of 70
    parse_config(configuration_of(scene, tmp_path, "stepped"), registry=discover())


def test_what_depends_on_the_wall_clock_says_so():
    real = {task.family for task in TASKS if task.real_time}
    stepped = {task.family for task in TASKS if not task.real_time}
    assert {"look", "move", "pick", "place", "again"} <= stepped - real
    assert {"recover", "clients", "several"} <= real - stepped


def test_servers_of_workers_get_as_much_of_a_busy_machine_as_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Ray would start workers, and with them the servers and modules, with niceness 15."""
    given: list[str | None] = []

    def connect(*_: object, **__: object) -> None:
        given.append(os.environ.get(NICENESS))
        raise ConfigurationError("no cluster")

    monkeypatch.setattr(run, "import_ray", lambda: None)
    monkeypatch.setattr(run, "connect", connect)
    monkeypatch.setenv(NICENESS, "")
    monkeypatch.delenv(NICENESS)
    plan = AgentPlan(subjects=("perfect",), tasks=("move-by",), seeds=1)
    with pytest.raises(ConfigurationError):
        list(run.play_on_workers(plan, tmp_path, [], 2))
    assert given == ["0"]


@pytest.mark.parametrize(("given", "expected_s"), [("", 120.0), ("720", 720.0)])
def test_a_call_may_take_as_long_as_the_episode_says(
    monkeypatch: pytest.MonkeyPatch, given: str, expected_s: float
):
    limits: list[float] = []

    async def call_tool(tool, arguments, read_timeout_seconds):
        limits.append(read_timeout_seconds)
        return SimpleNamespace(content=[], is_error=False, structured_content={})

    monkeypatch.setenv(CALL_TIMEOUT, given)
    if not given:
        monkeypatch.delenv(CALL_TIMEOUT)
    client: Any = SimpleNamespace(call_tool=call_tool)
    assert anyio.run(ToolClient(client).call_with, "run_task", {}).ok
    assert anyio.run(ToolClient(client).call_with, "run_task", {}, 5.0).ok
    assert limits == [expected_s, 5.0]


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(1700)
def test_a_busy_machine_and_two_workers_play_the_same_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    pytest.importorskip("ray", reason="needs the extra rn-eval[ray]")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    options = (
        "--subject",
        "perfect",
        "--tasks",
        "look-table,move-by,move-joint,put-by",
    )
    alone = evaluate(tmp_path / "alone", *options)
    busy = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(2)]
    try:
        beside = evaluate(tmp_path / "beside", *options, "--workers", "2")
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert {record.outcome.status for record in alone.values()} == {"success"}
    assert {record.time for record in alone.values()} == {"stepped"}
    digests = {task: record.outcome.digest for task, record in alone.items()}
    assert all(digests.values())
    assert {task: record.outcome.digest for task, record in beside.items()} == digests

"""`[tasks.monitor]` in a served cell: the shipped monitor agrees with a task that succeeds, and
ends one whose cube is the wrong one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import anyio
import pytest

from rn_testing.agent import Agent, client_of

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(300)]
CONFIG = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[inference]
backend = "servo"
[control]
controller = "urdf"
[supervisor]
start_timeout_s = 120.0
state_directory = "{state}"
[tasks.monitor]
name = "cubes-success"
acts = ["{act}"]
options = {{ colour = "{watched}" }}
wait_s = 20.0
"""
LIFTED = {
    "kind": "all",
    "of": [
        {"kind": "gripper_holds"},
        {"kind": "monitor", "name": "colour-lifted", "options": {"colour": "red"}},
    ],
}
NEVER = {"kind": "tcp_in", "lower_m": [9, 9, 9], "upper_m": [10, 10, 10]}


def outcome_of(
    folder: Path,
    environment: dict[str, str],
    *,
    act: str,
    watched: str,
    until: dict[str, Any],
) -> dict[str, Any]:
    """Start everything, let the arm pick up the red cube, and return the result of the task."""
    config = folder / "roboneuron.toml"
    config.write_text(CONFIG.format(state=folder / "state", act=act, watched=watched))

    async def scenario() -> dict[str, Any]:
        async with client_of(config, environment, "--log-level", "error") as client:
            agent = Agent(client)
            await agent.do("start_all")
            task = {"instruction": "pick up the red cube", "until": until, "max_s": 60.0}
            return await agent.do("run_task", **task, max_attempts=1)

    return anyio.run(scenario)


def test_it_confirms_a_cube_that_is_lifted(tmp_path: Path, environment: dict[str, str]) -> None:
    result = outcome_of(tmp_path, environment, act="confirm", watched="", until=LIFTED)
    assert result["outcome"] == "succeeded", result
    word = result["monitor"]
    assert (word["name"], word["says"], word["agrees"]) == ("cubes-success", "success", True)
    assert word["answers"] > 5


def test_it_ends_a_task_whose_cube_is_the_wrong_one(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    result = outcome_of(tmp_path, environment, act="fail", watched="green", until=NEVER)
    assert (result["outcome"], result["attempts"]) == ("failed", 1), result
    assert result["monitor"]["says"] == "failure"
    assert result["reason"].startswith("cubes-success says failure"), result
    assert "green cube" in result["reason"], result

"""A simulation below real time, as on a busy machine, arrives late: no watchdog ends its motion."""

from __future__ import annotations

from pathlib import Path

import anyio
import pytest

from rn_testing.agent import Agent, client_of

pytestmark = [pytest.mark.ros, pytest.mark.exhaustive, pytest.mark.timeout(120)]
CONFIG = """
[robot]
name = "fr3"
[plugins.fr3]
real_time_factor = 0.5
[supervisor]
state_directory = "{state}"
"""


def test_a_joint_motion_arrives_late(tmp_path: Path, environment: dict[str, str]) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(CONFIG.format(state=tmp_path / "state"))

    async def scenario() -> None:
        async with client_of(config, environment, "--log-level", "error") as client:
            do = Agent(client).do
            await do("start_robot")
            moved = await do("move_joints", positions={"fr3_joint1": 0.6}, duration_s=5.0)
            assert moved["error"] < 0.01
            assert moved["duration_s"] > 7.0, "twice as long as planned"

    anyio.run(scenario)

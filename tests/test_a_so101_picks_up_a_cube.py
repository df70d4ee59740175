"""`make demo-so101`: the simulated SO-101 picks up a cube over ROS and MCP, as judged by the
simulator; and the arm tools move this arm.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from anyio.from_thread import start_blocking_portal
from PIL import Image

from rn_standard.console.client import spawned_server
from rn_standard.demo.agent import DemoAgent
from roboneuron import NotReadyError

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_arm_lifts_the_cube_that_was_named(tmp_path: Path, environment: dict[str, str]) -> None:
    demo = [sys.executable, str(EXAMPLES / "demo_so101.py")]
    done = subprocess.run(
        [*demo, "--seed", "3", "--colour", "blue", "--output", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        timeout=280,
        env=environment,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "holding blue cube" in done.stdout
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames > 10  # type: ignore[attr-defined]


@pytest.mark.ros
@pytest.mark.timeout(180)
@pytest.mark.exhaustive
def test_the_tools_that_move_an_arm_move_this_one(
    tmp_path: Path, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    options = ["--config", str(EXAMPLES / "so101.toml")]
    with start_blocking_portal() as portal:
        server = portal.wrap_async_context_manager(spawned_server(options, tmp_path / "log"))
        with server as client:
            agent = DemoAgent(client)

            def call(tool: str, **arguments: object) -> dict[str, object]:
                return portal.call(agent.call, tool, arguments)

            call("start_robot")
            call("start_control")
            call("move_joints", positions={"shoulder_pan": 0.3})
            pan = call("read_joint_states")
            assert "shoulder_pan" in str(pan)
            call("move_ee", dz_m=-0.02)
            # with five joints the gripper cannot be tilted sideways
            with pytest.raises(NotReadyError):
                call("move_ee", rx_rad=0.2)

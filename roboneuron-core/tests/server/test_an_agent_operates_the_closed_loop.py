"""A real MCP client, a real server, real module processes over real ROS; robot, camera and policy
are fakes.
"""

from __future__ import annotations

import base64
import io
import json
import os
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from mcp import Client, StdioServerParameters, types
from PIL import Image

from rn_testing.fakes import gradient_image
from rn_testing.waiting import wait_for_line

pytestmark = [pytest.mark.ros, pytest.mark.timeout(120)]
ServeCommand = Callable[..., list[str]]


class Agent:
    """Calls tools; records the progress of the newest call."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self.progress: list[str] = []

    async def _call(self, name: str, arguments: dict[str, Any]) -> types.CallToolResult:
        self.progress = []

        async def note(progress: float, total: float | None, message: str | None) -> None:
            self.progress.append(message or "")

        return await self._client.call_tool(name, arguments, progress_callback=note)

    async def do(self, name: str, **arguments: Any) -> dict[str, Any]:
        """The structured result of a call that must succeed."""
        answer = await self._call(name, arguments)
        assert not answer.is_error, answer.content
        result: dict[str, Any] = answer.structured_content
        return result

    async def fail(self, name: str, **arguments: Any) -> tuple[str, str]:
        """Code and text of a call that must fail."""
        answer = await self._call(name, arguments)
        assert answer.is_error, answer.content
        return answer.meta["roboneuron/error"]["code"], answer.content[0].text  # type: ignore[union-attr]

    async def look(self, camera: str) -> tuple[dict[str, Any], np.ndarray[Any, Any]]:
        """Metadata and pixels of a camera's image, as PNG."""
        answer = await self._call("get_camera_image", {"camera": camera, "format": "png"})
        assert not answer.is_error, answer.content
        picture = next(block for block in answer.content if isinstance(block, types.ImageContent))
        assert picture.mime_type == "image/png"
        return answer.structured_content, np.asarray(
            Image.open(io.BytesIO(base64.b64decode(picture.data)))
        )

    async def module(self, kind: str) -> dict[str, Any]:
        """One module of get_status."""
        status = await self.do("get_status", details=True)
        return next(m for m in status["modules"] if m["module"] == kind)


async def agree(context: Any, params: types.ElicitRequestParams) -> types.ElicitResult:
    """A person who releases the emergency stop when the client asks."""
    return types.ElicitResult(action="accept", content={"confirmed": True})


def run_agent(
    command: list[str],
    environment: dict[str, str],
    scenario: Callable[[Agent], Awaitable[None]],
    mode: str = "auto",
) -> None:
    async def connect() -> None:
        server = StdioServerParameters(command=command[0], args=command[1:], env=environment)
        async with Client(server, mode=mode, elicitation_callback=agree) as client:  # type: ignore[arg-type]
            await scenario(Agent(client))

    anyio.run(connect)


def test_the_whole_loop_from_start_to_stop(
    serve_command: ServeCommand, server_environment: dict[str, str]
) -> None:
    pids: list[int] = []

    async def scenario(agent: Agent) -> None:
        robot = await agent.do("start_robot")
        assert robot["health"] == "ok"
        assert agent.progress[0] == "robot: starting"
        assert (await agent.module("robot"))["state"] == "active"
        await agent.do("start_perception")
        await agent.do("start_control")
        inference = await agent.do("start_inference")
        assert inference["started_with"]["backend"] == "picky"
        assert (await agent.module("inference"))["note"] == "waiting for an instruction"

        facts, pixels = await agent.look("front")
        assert (facts["width_px"], facts["height_px"]) == (64, 48)
        assert facts["age_ms"] < 1000
        assert np.array_equal(pixels, gradient_image(64, 48))

        told = await agent.do("set_instruction", instruction=" move on ")
        assert told["instruction"] == "move on"
        assert (await agent.module("inference"))["actions_for_instruction"] >= 1
        for _ in range(5):
            code, text = await agent.fail("set_instruction", instruction="fetch the unicorn")
            if code != "not_ready":  # else a busy machine has delivered no fresh image
                break
        assert (code, text) == (
            "ungrounded",
            "There is no unicorn in the image. Name what is visible.",
        )
        await agent.do("set_instruction", instruction="move on")

        code, text = await agent.fail("start_robot")
        assert code == "wrong_state"
        assert f"pid {robot['pid']}" in text

        stopped = await agent.do("emergency_stop", reason="a hand in the workspace")
        assert set(stopped["confirmed_by"]) == {"robot", "perception", "inference", "control"}
        assert stopped["took_s"] < 1.0
        status = await agent.do("get_status")
        assert status["emergency_stop"] is True
        assert status["emergency_stop_cause"] == 'agent on stdio: "a hand in the workspace"'
        assert (await agent.fail("set_instruction", instruction="move on"))[0] == "refused"
        assert (await agent.do("reset_emergency_stop"))["latched"] is False

        status = await agent.do("get_status")
        assert all(m["ready"] for m in status["modules"])
        pids.extend(m["pid"] for m in status["modules"])
        order = [s["module"] for s in (await agent.do("stop_all"))["stopped"]]
        assert order == ["inference", "control", "perception", "robot"]
        assert not any(os.path.exists(f"/proc/{pid}") for pid in pids)
        assert (await agent.do("stop_all"))["stopped"] == []

    run_agent(serve_command(), server_environment, scenario)
    assert len(pids) == 4


def test_a_camera_that_never_delivers_is_named_and_a_cancelled_start_leaves_nothing(
    serve_command: ServeCommand, server_environment: dict[str, str]
) -> None:
    async def scenario(agent: Agent) -> None:
        for _ in range(4):
            code, text = await agent.fail("start_perception")
            assert code == "not_ready"
            if "front" in text:  # else a busy machine has not started the process in time
                break
        assert "front" in text
        perception = await agent.module("perception")
        assert (perception["phase"], perception.get("pid")) == ("stopped", None)
        with anyio.move_on_after(3):
            await agent.do("start_perception")
        with anyio.fail_after(5):
            while (await agent.module("perception"))["phase"] != "stopped":
                await anyio.sleep(0.05)
        code, text = await agent.fail("get_camera_image", camera="front", timeout_s=0.5)
        assert code == "not_ready"
        assert "start_perception" in text
        code, text = await agent.fail("start_control")
        assert code == "not_ready"
        assert "is the robot running?" in text

    run_agent(
        serve_command(source="silent", start_timeout_s=7.0),
        server_environment,
        scenario,
        mode="legacy",
    )


def test_a_killed_module_shows_with_its_exit_and_can_be_started_again(
    serve_command: ServeCommand, server_environment: dict[str, str]
) -> None:
    async def scenario(agent: Agent) -> None:
        robot = await agent.do("start_robot")
        os.kill(robot["pid"], 9)
        with anyio.fail_after(2):
            while (await agent.module("robot"))["phase"] != "exited":
                await anyio.sleep(0.02)
        robot = await agent.module("robot")
        assert robot["exit"]["code"] == -9
        assert "pid" not in robot
        assert not robot["ready"]
        code, text = await agent.fail("stop_robot")
        assert code == "wrong_state"
        assert "signal 9" in text
        assert (await agent.do("start_robot"))["health"] == "ok"

    run_agent(serve_command(), server_environment, scenario)


def test_the_emergency_stop_outlives_the_server_and_stops_what_is_started_later(
    serve_command: ServeCommand, server_environment: dict[str, str], tmp_path: Path
) -> None:
    async def latch(agent: Agent) -> None:
        assert (await agent.do("emergency_stop", reason="smoke"))["confirmed_by"] == []

    async def find_it_latched(agent: Agent) -> None:
        robot = await agent.do("start_robot") | {"emergency_stop": False}
        with anyio.fail_after(2):
            while not robot["emergency_stop"]:
                robot = await agent.module("robot")
        code, text = await agent.fail("start_inference", instruction="move on")
        assert code == "refused"
        assert 'agent on stdio: "smoke"' in text
        assert (await agent.do("reset_emergency_stop"))["confirmed_by"] == ["robot"]
        assert (await agent.do("get_status"))["emergency_stop"] is False

    run_agent(serve_command(), server_environment, latch)
    run_agent(serve_command(), server_environment, find_it_latched)
    audit = (tmp_path / "state" / "audit.jsonl").read_text()
    assert [json.loads(line)["verdict"] for line in audit.splitlines()] == ["latched", "allowed"]


def test_an_image_topic_of_another_type_is_refused(
    serve_command: ServeCommand, server_environment: dict[str, str], tmp_path: Path
) -> None:
    script = (
        "from roboneuron.ros.environment import prepare_environment\nprepare_environment()\n"
        "import rclpy\nfrom std_msgs.msg import String\nrclpy.init()\nnode = "
        "rclpy.create_node('stranger')\n"
        "node.create_publisher(String, '/gantry/camera/front/image', 1)\nprint('up', "
        "flush=True)\nrclpy.spin(node)\n"
    )

    async def scenario(agent: Agent) -> None:
        code, text = await agent.fail("get_camera_image", camera="front", timeout_s=10)
        assert code == "configuration"
        assert "carries std_msgs/msg/String, expected sensor_msgs/msg/Image" in text

    environment = {**server_environment, "ROS_LOG_DIR": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-c", script], env=environment, stdout=subprocess.PIPE, text=True
    ) as stranger:
        try:
            wait_for_line(stranger.stdout, "up\n")
            run_agent(serve_command(), server_environment, scenario)
        finally:
            stranger.kill()

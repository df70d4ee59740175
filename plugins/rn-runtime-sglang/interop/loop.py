"""The closed loop on the simulated FR3: its model first in process, then served, then killed, then
in process again.

    loop.py --python SGLANG_ENVIRONMENT/bin/python [--device cpu] [--checkpoint DIRECTORY] loop.py
    --stand-in # the same without SGLang: its stand-in answers at once, with tokens of its own

It is an ordinary MCP client; a separate ROS node observes the topics. Exits with 1 if a check
fails.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import psutil
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client

from rn_runtime_sglang.standin.site import write_site
from rn_standard.demo.agent import DemoAgent, module_status
from rn_testing.domain import free_ros_domain
from rn_vla.openvla.tiny import STATISTICS_KEY, make_tiny
from roboneuron.errors import NotReadyError
from roboneuron.ros.environment import prepare_environment

_DISCOVERY_S = 10.0
"""Discovery time of an observer, which may detect new endpoints, and the end of dead ones, later
than the modules.
"""
INSTRUCTION = "pick up the red bowl"
_CONFIGURATION = """
[robot]
name = "fr3"
driver = "simulated"

[perception]
source = "fr3-sim-camera"

[inference]
backend = "openvla"
checkpoint = {checkpoint}
max_image_age_s = 5.0

[control]
controller = "urdf"
action_timeout_s = 1.0

[supervisor]
start_timeout_s = 600.0
state_directory = {state}

[plugins.fr3-sim-camera]
rate_hz = 5

[plugins.openvla]
profile = "libero"
unnorm_key = {key}

[plugins.sglang]
python = {python}
device = {device}
timeout_s = 10.0  # a busy CPU; keep it below 2 on a robot
start_timeout_s = 580.0
environment = {environment}
"""


class Witness:
    """Observes the robot's topics like any other ROS node."""

    def __init__(self) -> None:
        import rclpy
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64MultiArray

        rclpy.init()
        self._rclpy = rclpy
        self._node = rclpy.create_node("witness")
        self.actions = 0
        self.speed = 0.0
        self._joints: tuple[float, list[float]] | None = None
        self._node.create_subscription(Float64MultiArray, "/fr3/action", self._on_action, 10)
        self._node.create_subscription(JointState, "/fr3/joint_states", self._on_joints, 10)
        self._executor = rclpy.executors.SingleThreadedExecutor()
        self._executor.add_node(self._node)
        threading.Thread(target=self._executor.spin, daemon=True).start()

    def _on_action(self, message: Any) -> None:
        assert len(message.data) == 7
        self.actions += 1

    def _on_joints(self, message: Any) -> None:
        now_s, positions = time.monotonic(), list(message.position[:7])
        if self._joints is not None and now_s - self._joints[0] > 0.2:
            span_s = now_s - self._joints[0]
            self.speed = (
                max(abs(a - b) for a, b in zip(positions, self._joints[1], strict=True)) / span_s
            )
            self._joints = (now_s, positions)
        elif self._joints is None:
            self._joints = (now_s, positions)

    def topics(self) -> dict[str, str]:
        """Public topics of the robot with publishers, and their types.

        Hidden ones are left out as in `ros2 topic list`: those with a name part that begins with an
        underscore.
        """
        return {
            name: types[0]
            for name, types in self._node.get_topic_names_and_types()
            if name.startswith("/fr3/")
            and "/_" not in name
            and "transition_event" not in name
            and self._node.count_publishers(name)
        }

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._rclpy.try_shutdown()


class Story:
    """The steps, each printed with its results."""

    def __init__(self, agent: DemoAgent, witness: Witness, watch_s: float) -> None:
        self._agent = agent
        self._witness = witness
        self._watch_s = watch_s
        self.failures: list[str] = []

    def expect(self, condition: bool, text: str) -> None:
        """Print the result of a check, and store a failure."""
        print(f"  {'ok  ' if condition else 'FAIL'} {text}", flush=True)
        if not condition:
            self.failures.append(text)

    async def expect_topics(self, topics: dict[str, str]) -> None:
        """Compare the public topics with those before the switch, and print the differences."""
        ends_s = time.monotonic() + _DISCOVERY_S
        while (now := self._witness.topics()) != topics and time.monotonic() < ends_s:
            await asyncio.sleep(0.1)
        changed = dict(now.items() ^ topics.items())
        self.expect(
            not changed,
            "all topics and types are the same" + (f", but for {changed}" if changed else ""),
        )
        metrics = module_status(await self._agent.status(), "inference")["metrics"]
        hidden = [key for key in metrics if "._" in key]
        self.expect(
            not hidden, "the status names no hidden topic" + (f", but {hidden}" if hidden else "")
        )

    async def watch(self, name: str) -> dict[str, Any]:
        """Count actions for a while; returns the status of inference."""
        before, fastest = self._witness.actions, 0.0
        ends_s = time.monotonic() + self._watch_s
        while time.monotonic() < ends_s:
            await asyncio.sleep(0.2)
            fastest = max(fastest, self._witness.speed)
        count = self._witness.actions - before
        self.expect(
            count > 0,
            f"{name}: {count} actions in {self._watch_s:.0f} s, fastest joint {fastest:.3f} rad/s",
        )
        status = module_status(await self._agent.status(), "inference")
        numbers = {
            key.removeprefix("backend."): round(float(value), 1)
            for key, value in status["metrics"].items()
            if key.startswith("backend.")
        }
        print(f"       started with {status['started_with']}")
        print(f"       latency {status['latency_ms']} ms, {json.dumps(numbers)}", flush=True)
        return status

    async def play(self) -> None:
        """Run all steps."""
        agent, witness = self._agent, self._witness
        print(f"{len(await agent.tools())} tools", flush=True)
        for tool in ("start_robot", "start_perception", "start_control"):
            await agent.call(tool)
        await agent.call("start_inference", {"runtime": "torch", "instruction": INSTRUCTION})
        await self.watch("in process")
        topics = witness.topics()
        print(f"       topics: {', '.join(topics)}")
        switched = await agent.call("switch_inference", {"runtime": "sglang"})
        print(
            f"switched to the served model: took {switched['took_s']:.0f} s, gap "
            f"{switched.get('gap_s')} s"
        )
        await self.expect_topics(topics)
        status = await self.watch("served")
        self.expect(
            float(status["metrics"]["backend.served.servers_ready"]) == 1.0, "the server is ready"
        )
        await self.kill(status)
        switched = await agent.call("switch_inference", {"runtime": "torch"})
        print(f"switched back: took {switched['took_s']:.0f} s")
        await self.watch("in process again")
        await self.expect_topics(topics)
        await agent.call("stop_all")

    async def kill(self, status: dict[str, Any]) -> None:
        """Kill the server while the arm moves."""
        module = psutil.Process(status["pid"])
        server = next(
            c
            for c in module.children(recursive=True)
            if "rn_runtime_sglang.served" in " ".join(c.cmdline())
        )
        group = server.children(recursive=True)
        server.send_signal(signal.SIGKILL)
        killed_s = time.monotonic()
        print(f"killed the server (process {server.pid}) during motion")
        error: dict[str, Any] = {}
        while time.monotonic() - killed_s < 10.0 and "SIGKILL" not in error.get("message", ""):
            await asyncio.sleep(0.1)
            error = module_status(await self._agent.status(), "inference").get("error") or {}
        first = error.get("message", "none").splitlines()[0]
        self.expect("SIGKILL" in first, f"error after {time.monotonic() - killed_s:.1f} s: {first}")
        await asyncio.sleep(2.0)
        before = self._witness.actions
        await asyncio.sleep(2.0)
        self.expect(self._witness.actions == before, "no action any more")
        self.expect(
            self._witness.speed < 0.01,
            f"the arm holds: fastest joint {self._witness.speed:.4f} rad/s",
        )
        modules = (await self._agent.status())["modules"]
        others = {m["module"]: m["ready"] for m in modules if m["module"] != "inference"}
        self.expect(all(others.values()) and len(others) == 3, f"the rest runs on: {others}")
        _, alive = psutil.wait_procs(group, timeout=5.0)
        self.expect(not alive, "nothing of the server is left")


async def run(options: argparse.Namespace, directory: Path) -> bool:
    """Write checkpoint and configuration, start the server, run all steps."""
    checkpoint = options.checkpoint
    if checkpoint is None:
        checkpoint = directory / "tiny"
        make_tiny(checkpoint, seed=3)
    told = {
        "checkpoint": str(checkpoint),
        "state": str(directory / "state"),
        "key": STATISTICS_KEY,
        "python": str((options.python or Path(sys.executable)).absolute()),
        "device": options.device,
    }
    table = f'{{ PYTHONPATH = "{write_site(directory / "site")}" }}' if options.stand_in else "{}"
    path = directory / "roboneuron.toml"
    values = {name: json.dumps(value) for name, value in told.items()}
    path.write_text(_CONFIGURATION.format(**values, environment=table), encoding="utf-8")
    server = StdioServerParameters(
        command=sys.executable,
        args=["-m", "roboneuron.cli.main", "serve", "--config", str(path)],
        env=dict(os.environ),
    )
    witness = Witness()
    try:
        with (directory / "server.log").open("w", encoding="utf-8") as log:
            async with Client(stdio_client(server, errlog=log)) as client:
                story = Story(PatientAgent(client), witness, options.watch_s)
                try:
                    await story.play()
                except NotReadyError as error:
                    story.expect(False, str(error))
    finally:
        witness.close()
    if story.failures:
        print((directory / "server.log").read_text(encoding="utf-8")[-3000:])
    return not story.failures


class PatientAgent(DemoAgent):
    """Allows for the start time of an engine."""

    async def call(self, tool: str, arguments: Any = None) -> dict[str, Any]:
        """As `Agent.call`."""
        result = await self._client.call_tool(
            tool, dict(arguments or {}), read_timeout_seconds=650.0
        )
        if result.is_error:
            raise NotReadyError(
                f"{tool}: {' '.join(getattr(part, 'text', '') for part in result.content)}"
            )
        return dict(result.structured_content or {})


def main() -> int:
    """Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    server = parser.add_mutually_exclusive_group(required=True)
    server.add_argument("--python", type=Path)
    server.add_argument("--stand-in", action="store_true")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument(
        "--watch-s", type=float, default=8.0, help="how long the arm is watched after each switch"
    )
    options = parser.parse_args()
    os.environ.setdefault("ROS_DOMAIN_ID", str(free_ros_domain()))
    with tempfile.TemporaryDirectory(prefix="rn-interop-loop-") as held:
        prepare_environment(Path(held) / "ros")
        good = asyncio.run(run(options, Path(held)))
    print("PASSED" if good else "FAILED")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())

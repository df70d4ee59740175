"""Served arms for `lost_modules`: one FR3, two at one table, or two robots behind one server."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from anyio.from_thread import BlockingPortal
from mcp import Client
from plugin_site import installed

from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD
from rn_testing.agent import BlockingAgent, blocking_client
from roboneuron.ros.environment import prepare_environment

STILL_RAD_S = 0.02
COMMON = """
[supervisor]
state_directory = "{folder}/state"
start_timeout_s = 120.0
[ops.restart]
perception = "never"
[places.there]
position_m = [{x}, 0.3, 0.45]
{arm}
[places.back]
position_m = [{x}, -0.3, 0.45]
{arm}
[postures.turned]
joints = {{ {joint} = 2.0 }}
[postures.returned]
joints = {{ {joint} = -2.0 }}
"""
FR3 = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[inference]
backend = "servo"
[control]
controller = "urdf"
"""
ROS2 = """
[robot]
name = "fr3"
driver = "ros2-control"
[plugins.fr3]
controller = "/fr3_arm_controller"
connect_timeout_s = 60.0
[control]
controller = "urdf"
[[expose]]
name = "follow"
kind = "action"
topic = "/fr3_arm_controller/follow_joint_trajectory"
type = "control_msgs/action/FollowJointTrajectory"
"""
"""With a controller in a process of its own, which follows a goal also without the robot module."""
PAIR = """
[robot]
name = "fr3-pair"
[perception]
source = "fr3-pair-sim-camera"
cameras = ["front", "left_wrist"]
[inference]
backend = "servo-pair"
[control]
controller = "urdf"
"""
FLEET = """
[supervisor]
state_directory = "{folder}/state"
start_timeout_s = 120.0
[ops.restart]
perception = "never"
""" + "".join(
    f"""
[robots.{name}]
robot = "fr3"
[robots.{name}.perception]
source = "fr3-sim-camera"
cameras = ["front"]
[robots.{name}.inference]
backend = "servo"
[robots.{name}.control]
controller = "urdf"
"""
    for name in ("left", "right")
)
KINDS = ("robot", "perception", "control", "inference")
PLACES = {"fr3": (0.35, "", "fr3_joint7"), "pair": (0.35, 'arm = "left"', "left_fr3_joint7")}


class Witness:
    """Joints of the simulation, by their topic."""

    def __init__(self, link: Any, namespace: str) -> None:
        from sensor_msgs.msg import JointState  # heavy

        from roboneuron.ros.qos import NEWEST  # heavy

        self.states: list[tuple[float, np.ndarray, np.ndarray]] = []
        link.subscribe(JointState, f"/{namespace}/joint_states", self._on_state, NEWEST)

    def _on_state(self, message: Any) -> None:
        now_s = time.monotonic()
        self.states.append((now_s, np.array(message.position), np.array(message.velocity)))
        del self.states[:-6000]

    def moves(self) -> bool:
        """True if the newest state is of the last 0.3 s and moves."""
        if not self.states or time.monotonic() - self.states[-1][0] > 0.3:
            return False
        return bool(np.abs(self.states[-1][2]).max() > 3 * STILL_RAD_S)

    def moved_rad(self, since_s: float) -> float:
        """Largest distance of a joint from its first position since then [rad]."""
        positions = [position for at_s, position, _ in self.states if at_s >= since_s]
        if not positions:
            return 0.0
        return float(np.abs(np.array(positions) - positions[0]).max())


class Cell(BlockingAgent):
    """A served robot; calls block.

    Args:
        robot: its name in a fleet; empty for the only one.
    """

    def __init__(
        self, client: Client, portal: BlockingPortal, link: Any, namespace: str, robot: str = ""
    ) -> None:
        super().__init__(client, portal, **({"robot": robot} if robot else {}))
        self.witness = Witness(link, namespace)

    def run(self, *kinds: str) -> None:
        """Run these modules; inference without an instruction, or not at all."""
        modules = self.modules()
        for kind in KINDS:
            running = modules[kind]["phase"] == "running"
            if kind == "inference" and running and kind not in kinds:
                self.do("stop_inference")
            elif kind in kinds and not running:
                self.do(f"start_{kind}")


@contextlib.contextmanager
def controller(log: Path) -> Iterator[None]:
    """The stand-in for a controller of ros2_control, at the FR3's home."""
    command = [sys.executable, "-m", "rn_driver_ros2control.standin_node"]
    command += ["--controller", "/fr3_arm_controller", "--joints", *ARM_JOINTS]
    command += ["--start", *(str(value) for value in HOME_RAD)]
    with log.open("wb") as file, subprocess.Popen(command, stdout=file, stderr=file) as process:
        yield
        process.terminate()


@contextlib.contextmanager
def served(folder: Path, cell: str) -> Iterator[tuple[Cell, Cell | None]]:
    """A server; everything ends with it."""
    folder.mkdir(parents=True, exist_ok=True)
    text = FLEET.format(folder=folder)
    if cell != "fleet":
        x, arm, joint = PLACES.get(cell, PLACES["fr3"])
        common = COMMON.format(folder=folder, x=x, arm=arm, joint=joint)
        text = {"fr3": FR3, "pair": PAIR, "ros2": ROS2}[cell] + common
    config = folder / "roboneuron.toml"
    config.write_text(text)
    with contextlib.ExitStack() as stack:
        stack.enter_context(installed(folder, "lost-modules", ("lost_plugin",)))
        prepare_environment(folder / "log")
        from roboneuron.ros.link import RosLink  # heavy

        if cell == "ros2":
            stack.enter_context(controller(folder / "controller.log"))
        link = RosLink("witness")
        stack.callback(link.close)
        link.open()
        log = stack.enter_context((folder / "server.log").open("a"))
        served = blocking_client(config, os.environ, "--log-level", "warning", errors=log)
        client, portal = stack.enter_context(served)
        if cell == "fleet":
            yield (
                Cell(client, portal, link, "left", "left"),
                Cell(client, portal, link, "right", "right"),
            )
        else:
            yield Cell(client, portal, link, "fr3_pair" if cell == "pair" else "fr3"), None

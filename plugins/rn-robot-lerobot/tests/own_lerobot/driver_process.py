"""The driver `lerobot` with lerobot's own robots, without ROS: runs in lerobot's environment, with
one command per line of JSON in, and one answer per line out.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from operator import methodcaller
from typing import Any

import dynamixel_sdk.port_handler
import numpy as np
import scservo_sdk.port_handler
from geometry_msgs.msg import Twist

from rn_robot_lerobot import profile as profiles
from rn_robot_lerobot.lekiwi_driver import LekiwiDriver
from rn_robot_lerobot.lerobot_driver import LerobotDriver
from rn_robot_lerobot.lerobot_options import KochOptions, LekiwiOptions, LerobotDriverOptions
from roboneuron import JointCommand, RoboNeuronError

ROBOTS: dict[str, tuple[type[LerobotDriver], type[LerobotDriverOptions], Callable[[], Any]]] = {
    "so101": (LerobotDriver, LerobotDriverOptions, profiles.so101_profile),
    "koch": (LerobotDriver, KochOptions, profiles.koch_profile),
    "lekiwi": (LekiwiDriver, LekiwiOptions, profiles.lekiwi_profile),
}
BUSY_MS = 150
"""Half of the time limit of an answer [ms]: a test process simulates the motors, on a busy
machine.
"""


class Wires:
    """The part of `Topics` that a driver uses."""

    def __init__(self) -> None:
        self.listeners: dict[str, Callable[[Any], None]] = {}
        self.newest: dict[str, Any] = {}

    def now_ns(self) -> int:
        return time.time_ns()

    def advertise(self, topic: str, kind: type) -> Callable[[Any], None]:
        return partial(self.newest.__setitem__, topic)

    def subscribe(self, topic: str, kind: type, listener: Callable[[Any], None]) -> None:
        self.listeners[topic] = listener


def drive(wires: Wires, forwards: float, leftwards: float, turning: float) -> None:
    message = Twist()
    message.linear.x, message.linear.y = forwards, leftwards
    message.angular.z = turning
    wires.listeners["cmd_vel"](message)


def odometry(wires: Wires) -> dict[str, Any]:
    message = wires.newest["odom"]
    place, twist = message.pose.pose.position, message.twist.twist
    return {
        "frame": message.child_frame_id,
        "place": [place.x, place.y],
        "velocity": [twist.linear.x, twist.linear.y, twist.angular.z],
    }


def state(driver: LerobotDriver) -> dict[str, Any]:
    read = driver.read()
    joints = dict(zip(read.joints.names, read.joints.position.tolist(), strict=True))
    return {"joints": joints, "gripper_open": read.gripper_open, **read.detail}


def send(driver: LerobotDriver, positions: dict[str, float], seconds: float) -> dict[str, Any]:
    sent = driver.send(
        JointCommand(
            names=tuple(positions), position=np.array([*positions.values()]), duration_s=seconds
        )
    )
    return {"position": sent.position.tolist(), "duration_s": sent.duration_s}


def main() -> None:
    told = sys.stdout
    sys.stdout = sys.stderr  # lerobot prints
    for sdk in (dynamixel_sdk, scservo_sdk):
        sdk.port_handler.LATENCY_TIMER = BUSY_MS
    driver: LerobotDriver | None = None
    wires = Wires()
    for line in sys.stdin:
        name, *arguments = json.loads(line)
        try:
            if name == "new":
                robot, given = arguments
                made, model, profile = ROBOTS[robot]
                wires = Wires()
                driver = made(model.model_validate(given), profile(), wires)
                answer = None
            elif name in WIRED:
                answer = WIRED[name](wires, *arguments)
            else:
                assert driver is not None
                answer = COMMANDS[name](driver, *arguments)
            row = {"answer": answer}
        except RoboNeuronError as error:
            row = {"error": type(error).__name__, "message": str(error)}
        print(json.dumps(row), file=told, flush=True)


COMMANDS: dict[str, Callable[..., Any]] = {
    "open": methodcaller("open"),
    "read": state,
    "send": send,
    "hold": methodcaller("hold"),
    "close": methodcaller("close"),
}
WIRED: dict[str, Callable[..., Any]] = {"drive": drive, "odometry": odometry}


if __name__ == "__main__":
    main()

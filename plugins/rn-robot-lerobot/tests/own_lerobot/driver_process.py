"""The driver `lerobot` with lerobot's own robots, without ROS: runs in lerobot's environment, one
command a line of JSON in, one answer a line out.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import dynamixel_sdk.port_handler
import numpy as np
import scservo_sdk.port_handler

from rn_robot_lerobot import profile as profiles
from rn_robot_lerobot.lerobot_driver import LerobotDriver
from rn_robot_lerobot.lerobot_options import KochOptions, LerobotDriverOptions
from roboneuron import JointCommand, RoboNeuronError

ROBOTS: dict[str, tuple[type[LerobotDriverOptions], Callable[[], Any]]] = {
    "so101": (LerobotDriverOptions, profiles.profile),
    "koch": (KochOptions, profiles.koch_profile),
}
BUSY_MS = 150
"""Half of what an answer may take: a test's process plays the motors, on a machine that may be
busy.
"""


class Clock:
    """What the driver uses of `Topics`."""

    def now_ns(self) -> int:
        return time.time_ns()


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
    for line in sys.stdin:
        name, *arguments = json.loads(line)
        try:
            if name == "new":
                robot, given = arguments
                model, profile = ROBOTS[robot]
                driver = LerobotDriver(model.model_validate(given), profile(), Clock())
                answer = None
            else:
                assert driver is not None
                answer = COMMANDS[name](driver, *arguments)
            row = {"answer": answer}
        except RoboNeuronError as error:
            row = {"error": type(error).__name__, "message": str(error)}
        print(json.dumps(row), file=told, flush=True)


COMMANDS: dict[str, Callable[..., Any]] = {
    "open": LerobotDriver.open,
    "read": state,
    "send": send,
    "hold": LerobotDriver.hold,
    "close": LerobotDriver.close,
}


if __name__ == "__main__":
    main()

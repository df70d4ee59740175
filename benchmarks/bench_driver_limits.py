"""Time that the limits add to a command on its way to the driver.

    python benchmarks/bench_driver_limits.py

For the FR3: control's command for seven joints, as the robot module checks it when it comes and
limits it when it is sent, compared with the conversion of the message that both need: the joints
alone, with the places of the TCP, and with the distances of the links. And a planned trajectory of
50 points.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD, profile
from roboneuron.config import LimitsConfig
from roboneuron.contract import JointCommand, JointSample
from roboneuron.gate.motion import DriverLimiter, DriverPaths, MotionRules, motion_rules
from roboneuron.gate.motion.path_limits import PathLimiter
from roboneuron.ros.messages import commands_from_message, to_joint_trajectory


def timed(work: Callable[[], object]) -> float:
    """Milliseconds that `work` takes."""
    began_s = time.perf_counter()
    work()
    return (time.perf_counter() - began_s) * 1e3


def row(name: str, values: list[float]) -> None:
    """Print median and 99th percentile."""
    median, late = np.percentile(values, [50, 99])
    print(f"{name:54} {median:9.4f} {late:9.4f}  ms")


def driver_paths(*, collision: bool) -> DriverPaths:
    """The FR3's check of places, with its workspace, and with its collision bodies if asked for."""
    robot = profile() if collision else replace(profile(), collision=None)
    controller = UrdfController(None, robot)
    controller.load()
    rules = motion_rules(LimitsConfig(), robot)
    return DriverPaths(PathLimiter(rules, robot, controller.inspect, controller.poses), robot)


def check(paths: DriverPaths, commands: list[JointCommand]) -> None:
    """As the robot module checks a command that comes; a long one on a thread of its own."""
    paths.is_short(commands)
    paths.limit(commands)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--commands", type=int, default=5000)
    asked = parser.parse_args()
    limits = DriverLimiter(profile(), MotionRules(reactions={}))
    paths = {"places": driver_paths(collision=False), "distances": driver_paths(collision=True)}
    home = np.array(HOME_RAD)
    names = [
        *("conversion", "limits, one point", "places, one point", "distances, one point"),
        *("conversion of 50 points", "limits, 50 points", "distances, 50 points"),
    ]
    times: dict[str, list[float]] = {name: [] for name in names}
    for number in range(asked.commands):
        now_s = 0.05 * number
        place = home + 0.1 * np.sin(0.5 * now_s)
        limits.measure(JointSample(names=ARM_JOINTS, position=place))
        goal = home + 0.1 * np.sin(0.5 * (now_s + 0.05))
        command = JointCommand(names=ARM_JOINTS, position=goal, duration_s=0.05)
        one = to_joint_trajectory(command)
        times["conversion"].append(timed(partial(commands_from_message, one)))

        def pass_on(command: JointCommand = command, now_s: float = now_s) -> None:
            limits.admit([command], now_s)
            limits.note_sent(limits.limit(command, now_s).command, now_s)

        times["limits, one point"].append(timed(pass_on))
        for name, path in paths.items():
            path.measure(JointSample(names=ARM_JOINTS, position=place), now_s)
            times[f"{name}, one point"].append(timed(partial(check, path, [command])))
        if number % 50 == 0:
            places = [home + 0.1 * np.sin(0.5 * (now_s + 0.05 * k)) for k in range(1, 51)]
            plan = [
                JointCommand(names=ARM_JOINTS, position=place, duration_s=0.05) for place in places
            ]
            many = to_joint_trajectory(*plan)
            times["conversion of 50 points"].append(timed(partial(commands_from_message, many)))
            times["limits, 50 points"].append(timed(partial(limits.admit, plan, now_s)))
            times["distances, 50 points"].append(timed(partial(check, paths["distances"], plan)))
    print(f"{'':54} {'median':>9} {'p99':>9}")
    for name, values in times.items():
        row(name, values)


if __name__ == "__main__":
    main()

"""Time of the gate's check of joint motions, compared with bare forward kinematics of the same
postures.

    python benchmarks/bench_gate.py

For random moves of the FR3: the whole check of a joint trajectory (joint limits, then task-space
limits and distances of links and table along the path), and its floor, pinocchio's forward
kinematics of the same number of postures. And for control: one command through its limits, with and
without the distances. Both are interleaved in one run.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio

from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.limits import ARM_JOINTS, FINGER_OPEN_M
from rn_robot_fr3.profile import profile
from rn_robot_fr3.world import JOINTS
from rn_standard.direct_path.joints import check_joints
from rn_standard.direct_path.path_limits import PathLimiter
from roboneuron.config import LimitsConfig
from roboneuron.contract import Action, JointCommand, JointSample, RobotProfile
from roboneuron.errors import RefusedError
from roboneuron.gate.motion import MotionLimiter, motion_rules
from roboneuron.gate.motion.joint_space import JointLimit
from roboneuron.ros.messages import to_joint_trajectory


def timed(work: Callable[[], object]) -> float:
    """Milliseconds that `work` takes."""
    began_s = time.perf_counter()
    work()
    return (time.perf_counter() - began_s) * 1e3


def row(name: str, values: list[float], unit: str = "ms") -> None:
    """Print median and 99th percentile."""
    ordered = sorted(values)
    print(
        f"{name:58} {statistics.median(ordered):9.3f} "
        f"{ordered[int(0.99 * (len(ordered) - 1))]:9.3f}  {unit}"
    )


class Counting:
    """A controller that counts its inspections."""

    def __init__(self, robot: RobotProfile) -> None:
        self.controller = UrdfController(None, robot)
        self.controller.load()
        self.looks = 0

    def inspect(self, joints: JointSample) -> object:
        """Inspect like the controller, and count."""
        self.looks += 1
        return self.controller.inspect(joints)


def joint_motions(robot: RobotProfile, moves: int, seed: int) -> None:
    """Whole checks of single-point trajectories from home to random postures."""
    counting = Counting(robot)
    rules = replace(
        motion_rules(LimitsConfig(), robot), lower_m=np.full(3, -9.0), upper_m=np.full(3, 9.0)
    )
    judge = PathLimiter(rules, robot, counting.inspect)  # type: ignore[arg-type]
    model = pinocchio.buildModelFromXML(robot.urdf)
    data, full = model.createData(), np.zeros(model.nq)
    assert robot.limits is not None
    assert robot.home_rad is not None
    rng, limits = np.random.default_rng(seed), JointLimit.by_joint(robot)
    home = JointSample(names=JOINTS, position=np.append(robot.home_rad, [FINGER_OPEN_M] * 2))
    checks, floors, looks, ratios, passed = [], [], [], [], 0
    for _ in range(moves):
        target = rng.uniform(robot.limits.lower, robot.limits.upper)
        message = to_joint_trajectory(
            JointCommand(names=ARM_JOINTS, position=target, duration_s=60.0)
        )
        counting.looks = 0

        def check(message: object = message) -> bool:
            try:
                judge.check(check_joints(limits, [message], home), home)
            except RefusedError:
                return False
            return True

        def floor(count: int) -> None:
            for _ in range(count):
                pinocchio.forwardKinematics(model, data, full)

        began_s = time.perf_counter()
        is_allowed = check()
        took_ms = (time.perf_counter() - began_s) * 1e3
        count = counting.looks
        if not count:  # refused by the joint limits already
            continue
        passed += is_allowed
        checks.append(took_ms)
        looks.append(float(count))
        floors.append(timed(lambda count=count: floor(count)))  # type: ignore[misc]
        ratios.append(checks[-1] / floors[-1])
    row(f"check of a joint motion ({passed} of {len(checks)} pass)", checks)
    row("  postures looked at", looks, "")
    row("  per posture", [c / n for c, n in zip(checks, looks, strict=True)])
    row("floor: forward kinematics of as many postures", floors)
    row("  check / floor", ratios, "x")


def commands(robot: RobotProfile, count: int) -> None:
    """One command of control through its limits, with and without distances, interleaved."""
    limiters = {}
    for name, shown in (("with distances", robot), ("without", replace(robot, collision=None))):
        controller = UrdfController(None, shown)
        controller.load()
        rules = motion_rules(LimitsConfig(), shown)
        limiters[name] = (
            controller,
            MotionLimiter(rules, shown, controller.forward, controller.inspect),
            list[float](),
        )
    assert robot.home_rad is not None
    home = JointSample(names=JOINTS, position=np.append(robot.home_rad, [FINGER_OPEN_M] * 2))
    action = Action(
        translation_m=np.array([0.01, 0.0, -0.01]), rotation_rad=np.zeros(3), gripper_open=1.0
    )
    solved: list[float] = []
    for _ in range(count):
        for controller, limiter, took in limiters.values():
            limiter.rest(home, 0.0)
            began_s = time.perf_counter()
            command = controller.compute(action, home, 0.1)
            solved.append((time.perf_counter() - began_s) * 1e3)
            assert isinstance(command, JointCommand)
            began_s = time.perf_counter()
            verdict = limiter.limit(command, home, 0.1)
            took.append((time.perf_counter() - began_s) * 1e3)
            assert not verdict.acted, verdict.reason
    for name, (_, _, took) in limiters.items():
        row(f"a command of control through its limits, {name}", took)
    row("inverse kinematics of the same command", solved)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--moves", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    robot = profile()
    print(f"{'':58} {'median':>9} {'p99':>9}")
    joint_motions(robot, asked.moves, asked.seed)
    commands(robot, asked.moves)


if __name__ == "__main__":
    main()

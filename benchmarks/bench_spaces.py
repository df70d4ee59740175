"""Processing time of a row of each control space, from the backend's answer to the joint command,
compared with one of TCP deltas.

    python benchmarks/bench_spaces.py [--chunks 400]

It covers all steps that depend on the space, for the FR3 with its collision checks: a chunk is
created and checked, its row is converted to a message and checked, controller and limits compute
the command, and the command is converted to a message. The motions are the same small ones in all
spaces, interleaved in one run. Steps common to all (images, prediction, ROS) are left out.
"""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np

from rn_controller_urdf.controller import UrdfController
from rn_controller_urdf.plugin import roboneuron_controllers
from rn_robot_fr3.profile import HOME_RAD, profile
from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    EE_DELTA,
    GRIPPER,
    SPACE_KINDS,
    Action,
    ActionChunk,
    Hold,
    JointCommand,
    JointSample,
    robot_space,
)
from roboneuron.gate.motion import MotionLimiter, motion_rules
from roboneuron.modules.inference.agreement import SpaceAgreement, agree
from roboneuron.ros.messages import (
    row_from_action_message,
    to_action_message,
    to_joint_trajectory,
)

RATE_HZ = 15.0
STEP_S = 1.0 / RATE_HZ
SPEED = 0.05
"""Speed of a joint [rad/s] and of the TCP [m/s], at which no limit acts."""
F64 = np.ndarray


class Way:
    """All steps from answers in one space to commands."""

    def __init__(self, kind: str) -> None:
        robot = profile()
        self._controller = UrdfController(None, robot)
        self._controller.load()
        rules = motion_rules(LimitsConfig(), robot)
        self._limiter = MotionLimiter(
            rules, robot, self._controller.forward, self._controller.inspect
        )
        self._agreement: SpaceAgreement = agree(
            robot_space(kind, robot, RATE_HZ),
            robot,
            roboneuron_controllers()[0].spaces,
            backend="bench",
            controller="urdf",
        )
        self._joints = JointSample(names=robot.arm_joints, position=np.array(HOME_RAD))
        self._now_s = 1000.0
        self.took_ms: list[float] = []

    def go(self, sign: float) -> None:
        """Process and time one chunk of one row, and follow its command."""
        numbers = self._row(sign)
        begun_s = time.perf_counter()
        declared = self._agreement.declared
        chunk = ActionChunk(actions=numbers[None], step_s=STEP_S, space=declared)
        chunk = self._agreement.convert(chunk, self._joints)
        space = chunk.space
        message = to_action_message(chunk.actions[0], space)
        row = space.check(row_from_action_message(message)[1])
        answer: JointCommand | Hold
        if space is EE_DELTA:
            answer = self._controller.compute(Action.from_vector(row), self._joints, STEP_S)
        else:
            start = self._limiter.reference(self._joints, self._now_s)
            answer = self._controller.execute(space, row, start, STEP_S)
        assert isinstance(answer, JointCommand), answer
        verdict = self._limiter.limit(answer, self._joints, self._now_s)
        assert isinstance(verdict.command, JointCommand), verdict.reason
        to_joint_trajectory(verdict.command)
        self.took_ms.append((time.perf_counter() - begun_s) * 1e3)
        assert not verdict.acted, verdict.reason
        self._now_s += STEP_S
        names, count = self._joints.names, len(self._joints.names)
        self._joints = JointSample(names=names, position=verdict.command.position[:count])

    def _row(self, sign: float) -> F64:
        step = sign * SPEED * STEP_S
        kind, pose = self._agreement.declared.kind, self._controller.forward(self._joints)
        names, position = self._joints.names, self._joints.position
        numbers = {
            "ee_delta": {"dx_m": step},
            "ee_pose": dict(zip("xyz", pose.position_m + np.array([step, 0.0, 0.0]), strict=True))
            | {f"q{a}": q for a, q in zip("xyzw", pose.quaternion_xyzw, strict=True)},
            "joint_position": dict(zip(names, position + step, strict=True)),
            "joint_velocity": dict.fromkeys(names, sign * SPEED),
            "joint_delta": dict.fromkeys(names, step),
        }[kind]
        numbers |= {GRIPPER: 1.0}
        return np.array([numbers.get(key, 0.0) for key in self._agreement.declared.keys])


def measure(chunks: int) -> dict[str, float]:
    """Median time of one row by space [ms], interleaved."""
    ways = {kind: Way(kind) for kind in SPACE_KINDS}
    for chunk in range(chunks):
        for way in ways.values():
            way.go(1.0 if chunk % 20 < 10 else -1.0)
    return {kind: statistics.median(way.took_ms) for kind, way in ways.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--chunks", type=int, default=400, help="chunks of each space")
    took_ms = measure(parser.parse_args().chunks)
    floor_ms = took_ms["ee_delta"]
    print(f"{'space':16} {'ms':>8} {'ratio':>6}")
    for kind, median_ms in took_ms.items():
        print(f"{kind:16} {median_ms:8.3f} {median_ms / floor_ms:6.2f}")


if __name__ == "__main__":
    main()

"""Hostile commands for two FR3s at one table: for any simultaneous commands, no joint, no TCP and
no distance between the arms exceeds its limit, as computed by MuJoCo.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.limits import ACCELERATION_RAD_S2, LOWER_RAD, UPPER_RAD, VELOCITY_RAD_S
from rn_robot_fr3.profile import HOME_RAD, pair_profile
from rn_simulation.mujoco_scene import VISUAL_GROUP, read_urdf
from roboneuron import matrix_from_quaternion, matrix_from_rotvec, quaternion_from_matrix
from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    ControlSpace,
    JointCommand,
    JointSample,
    Pose,
    robot_space,
)
from roboneuron.errors import RoboNeuronError
from roboneuron.gate.motion import LIMITS, MotionLimiter, motion_rules

F64 = NDArray[np.float64]
ROBOT = pair_profile()
ARMS = ("left", "right")
MAX_SPEED_M_S, MAX_STEP_M = 0.6, 0.06
LEAST_HEIGHT_M, LEAST_DISTANCE_M = 0.05, 0.01
STRETCHED = np.array(HOME_RAD) + np.array([0.0, 0.9, 0.0, 0.9, 0.0, 0.2, 0.0])
"""Posture of each arm; two of them overlap in the middle of the table."""
PERIOD_S, LASTS_S = 0.05, 0.06
COMMANDS, FEW_COMMANDS = 120, 40
_FAR_M = 0.2


class Judge:
    """Both arms in MuJoCo, with its own kinematics and distances between shapes."""

    def __init__(self) -> None:
        self._model = read_urdf(ROBOT.urdf).compile()
        self._data = mujoco.MjData(self._model)
        joints = [self._model.joint(name) for name in ROBOT.arm_joints]
        self._places = np.array([joint.qposadr[0] for joint in joints])
        solid = [i for i in range(self._model.ngeom) if self._model.geom_group[i] != VISUAL_GROUP]
        name = {i: self._model.body(self._model.geom_bodyid[i]).name for i in solid}
        self._left, self._right = ([i for i in solid if name[i].startswith(arm)] for arm in ARMS)
        assert len(self._left) == len(self._right) > 15

    def look(self, position: F64) -> tuple[list[F64], float]:
        """TCP positions of both arms, and the smallest distance between their links."""
        self._data.qpos[self._places] = position
        mujoco.mj_kinematics(self._model, self._data)
        tcps = [self._data.body(f"{arm}_fr3_hand_tcp").xpos.copy() for arm in ARMS]
        return tcps, self._least_distance_m()

    def _least_distance_m(self) -> float:
        """Between a shape of each arm; at most `_FAR_M`. The pair with the nearest bounding spheres
        comes first, until the spheres alone are further apart than shapes that were measured.
        """
        middle, radius = self._data.geom_xpos, self._model.geom_rbound
        left, right = np.array(self._left), np.array(self._right)
        apart = np.linalg.norm(middle[left][:, None] - middle[right], axis=-1)
        bounds = apart - radius[left][:, None] - radius[right]
        least_m = _FAR_M
        for pair in np.argsort(bounds, axis=None):
            i, j = divmod(int(pair), len(right))
            if bounds[i, j] >= least_m:
                break
            found = mujoco.mj_geomDistance(
                self._model, self._data, self._left[i], self._right[j], _FAR_M, None
            )
            least_m = min(least_m, float(found))
        return least_m


@dataclass
class Run:
    """One sequence of commands through the gate; the arms follow the sent commands exactly."""

    limiter: MotionLimiter
    judge: Judge
    position: F64 = field(default_factory=lambda: np.tile(HOME_RAD, 2))
    velocity: F64 = field(default_factory=lambda: np.zeros(14))
    now_s: float = 0.0
    sent_s: float = -np.inf
    acted: Counter[str] = field(default_factory=Counter)
    nearest_m: float = np.inf
    travelled: float = 0.0

    def ask(self, target: F64, duration_s: float) -> None:
        """Send one command through the gate and check the result."""
        self.now_s += PERIOD_S
        sample = JointSample(names=ROBOT.arm_joints, position=self.position)
        verdict = self.limiter.limit(
            JointCommand(names=ROBOT.arm_joints, position=target, duration_s=duration_s),
            sample,
            self.now_s,
        )
        self.acted.update(verdict.acted)
        if not isinstance(verdict.command, JointCommand):
            self.velocity = np.zeros(14)
            self.limiter.rest(sample, self.now_s)
        else:
            self._check(verdict.command.position, verdict.command.duration_s)
        self.sent_s = self.now_s

    def _check(self, end: F64, duration_s: float) -> None:
        velocity = (end - self.position) / duration_s
        assert (end >= np.tile(LOWER_RAD, 2) - 1e-6).all()
        assert (end <= np.tile(UPPER_RAD, 2) + 1e-6).all()
        assert (np.abs(velocity) <= np.tile(VELOCITY_RAD_S, 2) * (1 + 1e-5)).all()
        change = np.abs(velocity - self.velocity)
        passed_s = min(self.now_s - self.sent_s, duration_s)
        assert (change <= np.tile(ACCELERATION_RAD_S2, 2) * passed_s * (1 + 1e-4) + 1e-9).all()
        start_m, _ = self.judge.look(self.position)
        end_m, apart_m = self.judge.look(end)
        _, half_way_m = self.judge.look((self.position + end) / 2.0)
        for start, stop in zip(start_m, end_m, strict=True):
            assert np.linalg.norm(stop - start) <= MAX_STEP_M + 1e-6
            assert np.linalg.norm(stop - start) / duration_s <= MAX_SPEED_M_S * 1.001
            assert stop[2] >= LEAST_HEIGHT_M - 1e-6
            assert ROBOT.workspace is not None
            assert (stop >= ROBOT.workspace.lower_m - 1e-6).all()
            assert (stop <= ROBOT.workspace.upper_m + 1e-6).all()
        # the two libraries agree on distances of cylinders within a tenth of a millimetre
        assert apart_m >= LEAST_DISTANCE_M - 1e-4
        assert half_way_m > 0.0, "the arms pass through each other on the way"
        self.nearest_m = min(self.nearest_m, apart_m)
        self.travelled += float(np.abs(end - self.position).sum())
        # the arm is where the command has taken it when the next one comes
        share = min(1.0, PERIOD_S / duration_s)
        self.position = self.position + (end - self.position) * share
        # after its end an arm decelerates within its limit
        left = np.abs(velocity) - np.tile(ACCELERATION_RAD_S2, 2) * max(0.0, PERIOD_S - duration_s)
        self.velocity = np.sign(velocity) * np.maximum(left, 0.0)


def _gate(reaction: str) -> MotionLimiter:
    config = LimitsConfig(
        max_step_m=MAX_STEP_M,
        max_step_rad=0.4,
        max_speed_m_s=MAX_SPEED_M_S,
        max_turn_rad_s=4.0,
        min_height_m=LEAST_HEIGHT_M,
    ).model_copy(update={f"on_{name}": reaction for name in LIMITS})
    controller = UrdfController(None, ROBOT)
    controller.load()
    return MotionLimiter(
        motion_rules(config, ROBOT),
        ROBOT,
        controller.forward,
        controller.inspect,
        poses=controller.poses,
    )


def _hostile(rng: np.random.Generator, run: Run) -> Iterator[tuple[F64, float]]:
    """Commands of both arms into each other, beyond limits, to random targets and back, in random
    times.
    """
    goal = np.tile(HOME_RAD, 2)
    for number in range(COMMANDS):
        if number % 20 == 0:
            lean = rng.normal(0.0, 0.15, 14)
            goal = rng.choice(
                np.array(
                    [
                        np.tile(STRETCHED, 2) + lean,
                        rng.uniform(np.tile(LOWER_RAD, 2) - 0.3, np.tile(UPPER_RAD, 2) + 0.3),
                        np.tile(STRETCHED, 2) - lean,
                    ]
                )
            )
        step = goal - run.position
        size = float(rng.choice([0.03, 0.1, 0.3]))
        target = run.position + step * min(1.0, size / max(1e-9, float(np.abs(step).max())))
        if rng.random() < 0.03:
            target[int(rng.integers(14))] = rng.choice([np.nan, np.inf, 1e9])
        yield target, float(rng.choice([1e-3, LASTS_S, LASTS_S, 0.2]))


@pytest.mark.parametrize("reaction", ["scale", "hold"])
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.exhaustive) for seed in range(1, 4))]
)
def test_hostile_commands_for_both_arms_stay_within_every_limit(reaction: str, seed: int) -> None:
    run = Run(limiter=_gate(reaction), judge=Judge())
    for target, duration_s in _hostile(np.random.default_rng(seed), run):
        run.ask(target, duration_s)
    assert run.acted, "nothing that was asked had to be limited"


KINDS = ("ee_pose", "joint_position", "joint_velocity")


def _hostile_row(
    space: ControlSpace, run: Run, poses: tuple[Pose, ...], rng: np.random.Generator, lean: F64
) -> F64:
    """A row for both arms: continued motion in one direction, mostly into each other, and damaged
    values.
    """
    named = dict.fromkeys(space.keys, float(rng.choice([0.0, 0.4, 1.0])))
    size = float(rng.choice([0.01, 0.05, 1.0], p=[0.4, 0.4, 0.2]))
    if space.kind == "ee_pose":
        middle_m = (poses[0].position_m + poses[1].position_m) / 2.0
        for arm, pose, push in zip(ARMS, poses, lean.reshape(2, 7), strict=True):
            towards = 0.2 * (middle_m - pose.position_m) + 0.3 * push[:3] + rng.normal(0, 0.02, 3)
            place_m = pose.position_m + size * towards
            turn = matrix_from_rotvec(size * 0.5 * push[3:6]) @ matrix_from_quaternion(
                pose.quaternion_xyzw
            )
            quaternion = quaternion_from_matrix(turn) * rng.choice([-1.0, 1.0, 1.05])
            named |= {f"{arm}/{x}": v for x, v in zip("xyz", place_m, strict=True)}
            named |= {f"{arm}/q{x}": v for x, v in zip("xyzw", quaternion, strict=True)}
    else:
        step = size * np.clip(np.tile(STRETCHED, 2) + lean - run.position, -0.2, 0.2)
        value = run.position + step if space.kind == "joint_position" else step / PERIOD_S
        keys = (key for key in space.keys if not key.endswith("gripper_open"))
        named |= dict(zip(keys, value, strict=True))
    row = np.array([named[key] for key in space.keys])
    if rng.random() < 0.03:
        row[int(rng.integers(len(row)))] = rng.choice([np.nan, np.inf, 1e9])
    return row


@pytest.mark.parametrize(
    "rows",
    [
        FEW_COMMANDS,
        pytest.param(COMMANDS, marks=pytest.mark.exhaustive),
        pytest.param(10_000, marks=[pytest.mark.slow, pytest.mark.timeout(600)]),
    ],
)
@pytest.mark.parametrize("reaction", ["scale", "hold"])
@pytest.mark.parametrize("kind", KINDS)
def test_hostile_rows_for_both_arms_stay_within_every_limit(
    kind: str, reaction: str, rows: int
) -> None:
    run, controller = Run(limiter=_gate(reaction), judge=Judge()), UrdfController(None, ROBOT)
    controller.load()
    rng = np.random.default_rng([KINDS.index(kind), reaction == "hold"])
    space, lean, refused = robot_space(kind, ROBOT, 1.0 / PERIOD_S), np.zeros(14), 0
    for number in range(rows):
        if number % 15 == 0:
            lean = rng.normal(0.0, rng.choice([0.05, 0.3, 1.0]), 14)
        sample = JointSample(names=ROBOT.arm_joints, position=run.position)
        try:
            row = space.check(_hostile_row(space, run, controller.poses(sample), rng, lean))
        except RoboNeuronError:
            refused += 1
            continue
        answer = controller.execute(
            space, row, run.limiter.reference(sample, run.now_s + PERIOD_S), PERIOD_S
        )
        if isinstance(answer, JointCommand):
            arm = [answer.names.index(name) for name in ROBOT.arm_joints]
            lasts_s = answer.duration_s + float(rng.choice([0.0, 0.01, 0.1]))
            run.ask(answer.position[arm], lasts_s)
        else:
            refused += 1
    assert run.acted, "nothing that was asked had to be limited"
    assert run.travelled > 0.2
    assert refused < rows


def test_arms_that_are_sent_into_each_other_stop_apart() -> None:
    """The judge must see a small distance: it proves that the limit acts, and not that neither arm
    moves.
    """
    run = Run(limiter=_gate("scale"), judge=Judge())
    for _ in range(150):
        step = np.tile(STRETCHED, 2) - run.position
        run.ask(run.position + step * min(1.0, 0.04 / float(np.abs(step).max())), LASTS_S)
    assert run.acted["collision"] > 0
    assert run.travelled > 0.5
    assert LEAST_DISTANCE_M - 1e-4 <= run.nearest_m < 0.03


def test_the_judge_sees_arms_that_overlap() -> None:
    _, apart_m = Judge().look(np.tile(STRETCHED, 2))
    assert apart_m < 0.0

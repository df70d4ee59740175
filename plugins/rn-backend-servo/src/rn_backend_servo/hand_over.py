"""The hand-over policy: one arm picks the cube up and presents it to the other, which takes it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from rn_backend_servo.geometry import rotation_between
from rn_backend_servo.options import HandOverOptions
from rn_backend_servo.phases import OPEN, Phase
from rn_backend_servo.policy import PickPolicy
from rn_backend_servo.sight import Sighting
from roboneuron import Action, ArmState, Pose, UngroundedError, apply_delta

F64 = NDArray[np.float64]

_NEAR_M, _NEAR_RAD = 0.004, 0.04
"""Tolerances within which a TCP has reached a goal."""
_MOST_STEPS = 250
"""Step limit of one stage; beyond it an arm does not reach its goal."""
_GRIP_STEPS = 12
"""Number of actions after which a gripper has closed or opened."""
_SHOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation of the giver's TCP: along +y, fingers above and below the cube. Along the line between
the two arms the wrist would pass a singularity.
"""
_TAKING = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""Rotation of the taker's TCP: along -y, fingers beside the cube."""
_GRIP, _LOST = 0.42, 0.46
"""Opening that squeezes the smallest cube (40 of 80 mm), and the one below which no cube is held.
If they closed further, the fingers of one hand would be commanded into those of the other.
"""
_HOLDS_GIVER = frozenset({"SHOW", "READY", "REACH", "TAKE"})


class Stage(Enum):
    """Stages of the hand-over; the value is shown to the agent."""

    PICK = "picking up"
    SHOW = "showing"
    READY = "getting ready for"
    REACH = "reaching for"
    TAKE = "taking"
    GIVE = "letting go of"
    PART = "drawing back from"
    DONE = "handed over"


@dataclass(frozen=True, kw_only=True, slots=True)
class ArmGoal:
    """Next goal of one arm.

    Attributes:
        pose: TCP pose in the base frame, a small motion away.
        gripper_open: 0 closed .. 1 open.
    """

    pose: Pose
    gripper_open: float


class HandOverPolicy:
    """Pick, show, get ready, reach, take, give, part; each stage starts when both arms have reached
    the goals of the previous one.

    The giver stands at the base frame's origin and the taker faces it along x.
    """

    def __init__(self, options: HandOverOptions) -> None:
        self._options = options
        self.pick = PickPolicy(options)
        self.reset()

    def reset(self) -> None:
        """Reset the policy."""
        self.pick.reset()
        self.stage = Stage.PICK
        self._steps = 0
        self._rest: Pose | None = None

    def step(
        self, sighting: Sighting | None, giver: ArmState, taker: ArmState
    ) -> tuple[ArmGoal, ArmGoal]:
        """Goals of giver and taker.

        Raises:
            UngroundedError: all grasps failed, the cube was lost, or an arm does not reach its
                goal.
        """
        self._steps += 1
        if self._steps > _MOST_STEPS and self.stage is not Stage.DONE:
            raise UngroundedError(
                f"The arms are stuck while {self.stage.value} the cube.",
                hint="Give the instruction again to restart.",
            )
        if self.stage is Stage.PICK:
            return self._pick(sighting, giver, taker)
        held = giver if self.stage.name in _HOLDS_GIVER else taker
        if (held.gripper_open or 0.0) <= _LOST and self._steps > _GRIP_STEPS:
            raise UngroundedError(
                f"The cube was lost while {self.stage.value} it.",
                hint="Give the instruction again to restart.",
            )
        goals = self._goals()
        (shown, giver_open), (reached, taker_open) = goals
        are_there = self._is_near(giver, shown) and self._is_near(taker, reached)
        waits = self.stage in (Stage.TAKE, Stage.GIVE) and self._steps < _GRIP_STEPS
        if are_there and not waits and self.stage is not Stage.DONE:
            self._enter(list(Stage)[list(Stage).index(self.stage) + 1])
        return (
            ArmGoal(pose=self._nearer(giver.ee_pose, shown), gripper_open=giver_open),
            ArmGoal(pose=self._nearer(taker.ee_pose, reached), gripper_open=taker_open),
        )

    def _enter(self, stage: Stage) -> None:
        self.stage, self._steps = stage, 0

    def _pick(
        self, sighting: Sighting | None, giver: ArmState, taker: ArmState
    ) -> tuple[ArmGoal, ArmGoal]:
        self._rest = self._rest or taker.ee_pose
        start = giver.ee_pose.matrix
        motion = self.pick.step(sighting, start, giver.gripper_open or 0.0)
        if self.pick.episode.phase is Phase.HOLD:
            self._enter(Stage.SHOW)
        action = Action(
            translation_m=motion.translation_m,
            rotation_rad=motion.rotation_rad,
            gripper_open=motion.gripper_open,
        )
        return (
            ArmGoal(pose=apply_delta(giver.ee_pose, action), gripper_open=motion.gripper_open),
            ArmGoal(pose=self._rest, gripper_open=OPEN),
        )

    def _goals(self) -> tuple[tuple[F64, float], tuple[F64, float]]:
        """TCP pose (4, 4) and opening of giver and taker at the end of the stage."""
        apart_m, stage = self._options.apart_m, self.stage
        assert self._rest is not None
        giver_open = _GRIP if stage.name in _HOLDS_GIVER else OPEN
        taker_open = _GRIP if stage in (Stage.TAKE, Stage.GIVE, Stage.PART, Stage.DONE) else OPEN
        shown = self._at(_SHOWN, -apart_m if stage in (Stage.PART, Stage.DONE) else 0.0)
        reached = self._at(_TAKING, apart_m if stage is Stage.READY else 0.0)
        if stage is Stage.SHOW:
            reached = self._rest.matrix
        return (shown, giver_open), (reached, taker_open)

    def _at(self, rotation: F64, along_y_m: float) -> F64:
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = self._options.meeting_m
        pose[1, 3] += along_y_m
        return pose

    def _is_near(self, arm: ArmState, goal: F64) -> bool:
        pose = arm.ee_pose.matrix
        turn = np.linalg.norm(rotation_between(pose[:3, :3], goal[:3, :3]))
        return bool(np.linalg.norm(goal[:3, 3] - pose[:3, 3]) < _NEAR_M and turn < _NEAR_RAD)

    def _nearer(self, pose: Pose, goal: F64) -> Pose:
        """A bounded fraction of the motion from a measured pose to `goal`."""
        options, start = self._options, pose.matrix
        way = options.gain * (goal[:3, 3] - start[:3, 3])
        turn = options.gain * rotation_between(start[:3, :3], goal[:3, :3])
        far_m, far_rad = float(np.linalg.norm(way)), float(np.linalg.norm(turn))
        # one fraction for both, so that the hand rotates during the translation and not at its end
        share = min(
            1.0,
            options.max_step_m / far_m if far_m else 1.0,
            options.max_turn_rad / far_rad if far_rad else 1.0,
        )
        action = Action(translation_m=share * way, rotation_rad=share * turn, gripper_open=OPEN)
        return apply_delta(pose, action)

"""Rows of joint policies: joints and gripper of each arm in turn, by the robot's names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from roboneuron import (
    GRIPPER,
    Channel,
    ConfigurationError,
    ControlSpace,
    Observation,
    RobotProfile,
    UngroundedError,
    UnsafeError,
)

F64 = NDArray[np.float64]
JointGripper = Literal["open_fraction", "closed_fraction"]
JointKind = Literal["joint_position", "joint_velocity"]


@dataclass(frozen=True, kw_only=True, slots=True)
class PlatformJoints:
    """Layout of one platform's states and actions.

    Attributes:
        kind: "joint_position" [rad] or "joint_velocity" [rad/s].
        joints: number of joints per arm, from the base to the tip.
        rate_hz: rows per second that the policy was trained for.
        gripper: 0..1 "open_fraction" 0 closed, "closed_fraction" 0 open; absolute in every kind.
        arms: names of the arms; one empty name for a robot with one arm.
    """

    kind: JointKind
    joints: int
    rate_hz: float
    gripper: JointGripper
    arms: tuple[str, ...] = ("",)

    @property
    def columns(self) -> tuple[str, ...]:
        """Kind of each value, in order: "joint" or "gripper"."""
        return (*("joint",) * self.joints, "gripper") * len(self.arms)

    @property
    def width(self) -> int:
        """Number of values."""
        return len(self.arms) * (self.joints + 1)

    @property
    def grippers(self) -> NDArray[np.bool_]:
        """bool (width,), True at the grippers."""
        return np.array([column == "gripper" for column in self.columns])

    def space(self, names: Sequence[str]) -> ControlSpace:
        """Control space of the rows, for a robot whose joints have these names, in the policy's
        order.

        Raises:
            ConfigurationError: another number of joints, or a joint repeated within an arm.
        """
        unit = "rad" if self.kind == "joint_position" else "rad/s"
        channels: list[Channel] = []
        for arm, part in self._by_arm(names).items():
            channels += [Channel(name=name, unit=unit, arm=arm) for name in part]
            channels.append(Channel(name=GRIPPER, unit="opening", arm=arm))
        return ControlSpace(kind=self.kind, channels=tuple(channels), rate_hz=self.rate_hz)

    def read_state(self, observation: Observation, names: Sequence[str]) -> F64:
        """Measured joints [rad] and gripper of each arm, float64 (width,).

        Joints are read by name, grippers by arm; gripper values follow the policy's convention
        (`gripper`).

        Raises:
            ConfigurationError: as `space`.
            UngroundedError: a joint or a gripper is not measured.
            UnsafeError: a measured value is not finite.
        """
        joints = observation.joints
        measured: dict[str, float] = {}
        if joints is not None:
            measured = dict(zip(joints.names, joints.position.tolist(), strict=True))
        values: list[float] = []
        absent: list[str] = []
        for arm, part in self._by_arm(names).items():
            absent += [name for name in part if name not in measured]
            opening = _opening(observation, arm)
            if opening is None:
                absent.append(f"the gripper's opening{f' of arm {arm!r}' if arm else ''}")
                continue
            values += [measured.get(name, 0.0) for name in part]
            values.append(float(self.to_opening(np.array(opening))))
        if absent:
            raise UngroundedError(
                f"The state needs {', '.join(absent)}; the joints that are measured are "
                f"{', '.join(measured) or 'none'}.",
                hint="Correct the option 'joints', or make sure that the robot's joint_states hold "
                "them.",
            )
        state = np.array(values)
        if not np.isfinite(state).all():
            raise UnsafeError(f"The measured state holds a non-finite value: {state.tolist()}.")
        return state

    def to_contract(self, actions: F64) -> F64:
        """Convert un-normalised actions (H, width) to rows of `space`; openings are clipped to
        0..1.
        """
        rows = actions.copy()
        at = self.grippers
        rows[:, at] = np.clip(self.to_opening(actions[:, at]), 0.0, 1.0)
        return rows

    def to_opening(self, values: F64) -> F64:
        """Convert the policy's gripper values to openings 0 closed..1 open, and back: it is its own
        inverse.
        """
        return 1.0 - values if self.gripper == "closed_fraction" else values

    def _by_arm(self, names: Sequence[str]) -> dict[str, Sequence[str]]:
        """The names of each arm's joints. Raises ConfigurationError as `space`."""
        count = len(self.arms) * self.joints
        starts = range(0, count, self.joints)
        own = {arm: names[i : i + self.joints] for arm, i in zip(self.arms, starts, strict=True)}
        if len(names) != count or any(len(set(part)) != self.joints for part in own.values()):
            raise ConfigurationError(
                f"The option 'joints' names {len(names)} joints ({', '.join(names)}), the policy "
                f"moves {count}, each of an arm's once.",
                hint="Name them in the policy's order, from the base to the tip of each arm.",
            )
        return own


def declare_joints(
    rows: PlatformJoints, options: Mapping[str, object], profile: RobotProfile, *, policy: str
) -> ControlSpace:
    """The space of a policy whose joints the option `joints` names, for `BackendSpec.space`.

    Args:
        rows: layout of the policy.
        options: options of the backend.
        profile: profile of the robot.
        policy: name of the policy in messages, as the subject of a sentence.

    Raises:
        ConfigurationError: the option is missing, or does not match the policy or the robot.
    """
    joints = options.get("joints")
    robots = ", ".join(f'"{joint}"' for joint in profile.arm_joints)
    hint = f"Robot {profile.name!r} has, from base to tip: joints = [{robots}]"
    if not isinstance(joints, list | tuple) or not all(isinstance(j, str) for j in joints):
        raise ConfigurationError(
            f"{policy} needs the option 'joints': the robot's joints in the policy's order.",
            hint=hint,
        )
    space = rows.space(joints)
    absent = [joint for joint in joints if joint not in profile.arm_joints]
    if absent:
        raise ConfigurationError(
            f"The option 'joints' names {', '.join(absent)}, which robot {profile.name!r} does not "
            "have.",
            hint=hint,
        )
    return space


def _opening(observation: Observation, arm: str) -> float | None:
    """Measured opening of an arm's gripper; None if it is not measured."""
    if not arm:
        return observation.gripper_open
    state = observation.arms.get(arm)
    return None if state is None else state.gripper_open

"""Checkpoints that act on joints: absolute positions [rad] and grippers, arm by arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_backend_oft.constants import Constants
from roboneuron import (
    GRIPPER,
    Channel,
    ConfigurationError,
    ControlSpace,
    Observation,
    UngroundedError,
)

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class JointActions:
    """What the rows of such a checkpoint are.

    Attributes:
        constants: of the platform; its state is "joints".
        joints: the robot's names of the policy's joints, in the policy's order.

    Raises:
        ConfigurationError: another number of joints than the platform has, or a name twice.
    """

    constants: Constants
    joints: tuple[str, ...]

    def __post_init__(self) -> None:
        constants = self.constants
        each, rest = divmod(constants.action_width, len(constants.arms))
        count = constants.action_width - len(constants.arms)
        if rest or each < 2:
            raise ConfigurationError(
                f"action_width {constants.action_width} is no joints and a gripper for each of "
                f"{len(constants.arms)} arms."
            )
        if len(self.joints) != count or any(
            len(set(part)) != each - 1 for part in self._by_arm().values()
        ):
            raise ConfigurationError(
                f"The option 'joints' names {len(self.joints)} joints ({', '.join(self.joints)}), "
                f"the policy moves {count}, each of an arm's once.",
                hint="Name them in the policy's order, from the base to the tip of each arm.",
            )

    @property
    def space(self) -> ControlSpace:
        """Joints and gripper of each arm in turn."""
        channels: list[Channel] = []
        for arm, part in self._by_arm().items():
            channels += [Channel(name=name, unit="rad", arm=arm) for name in part]
            channels.append(Channel(name=GRIPPER, unit="opening", arm=arm))
        rate_hz = 1.0 / self.constants.step_s
        return ControlSpace(kind="joint_position", channels=tuple(channels), rate_hz=rate_hz)

    def to_contract(self, native: F64) -> F64:
        """Un-normalised rows (H, n) -> rows of `space`; openings are cut to 0..1."""
        rows = native.copy()
        at = self._grippers()
        rows[:, at] = np.clip(self._opening(native[:, at]), 0.0, 1.0)
        return rows

    def read_state(self, observation: Observation) -> F64:
        """float64 (n,), measured joints and gripper of a robot with one arm, un-normalised.

        Raises:
            UngroundedError: a joint or the gripper is missing or not finite.
        """
        joints, opening = observation.joints, observation.gripper_open
        known = () if joints is None else joints.names
        absent = [name for name in self.joints if name not in known]
        if joints is None or opening is None or absent:
            missing = ", ".join(absent) or "gripper opening"
            raise UngroundedError(
                f"The observation has no {missing}, which the checkpoint's proprioception needs."
            )
        positions = [joints.position[known.index(name)] for name in self.joints]
        state = np.append(positions, self._opening(np.float64(opening)))
        if not np.isfinite(state).all():
            raise UngroundedError(
                f"The measured state holds a non-finite value: {np.round(state, 4).tolist()}."
            )
        return state

    def _opening(self, values: F64 | np.float64) -> F64 | np.float64:
        """The checkpoint's gripper -> opening, and back: it is its own inverse."""
        return 1.0 - values if self.constants.gripper == "closed_fraction" else values

    def _grippers(self) -> NDArray[np.intp]:
        each = self.constants.action_width // len(self.constants.arms)
        return np.arange(each - 1, self.constants.action_width, each)

    def _by_arm(self) -> dict[str, tuple[str, ...]]:
        count = self.constants.action_width // len(self.constants.arms) - 1
        starts = range(0, count * len(self.constants.arms), count)
        return {
            arm: self.joints[start : start + count]
            for arm, start in zip(self.constants.arms, starts, strict=True)
        }

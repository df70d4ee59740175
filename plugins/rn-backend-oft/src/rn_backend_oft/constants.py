"""Constants of a training platform that the checkpoint does not say: they are options, never
guessed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from rn_vla.joint_rows import JointGripper, PlatformJoints
from rn_vla.openvla.statistics import Bounds
from roboneuron import ConfigurationError

StateLayout = Literal["xyz_rotvec_fingers", "xyz_rpy_opening", "joints"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Constants:
    """What one platform was trained with.

    Attributes:
        chunk: actions per inference.
        action_width: values per action.
        state: how proprioception is laid out.
        bounds: which statistics -1 and +1 stand for.
        arms: names of the arms, of platforms that act on joints; one empty name for one arm.
        gripper: of platforms that act on joints: "open_fraction" 0 closed .. 1 open, or the
            reverse.
        step_s: time between two actions [s] of platforms that act on joints; the profile says it
            for others.
    """

    chunk: int
    action_width: int
    state: StateLayout
    bounds: Bounds
    arms: tuple[str, ...] = ("",)
    gripper: JointGripper = "open_fraction"
    step_s: float = 0.0

    @property
    def tokens(self) -> int:
        """Placeholder tokens, one per value."""
        return self.chunk * self.action_width

    def rows(self) -> PlatformJoints:
        """What the rows are, of a platform whose state is "joints".

        Raises:
            ConfigurationError: `action_width` is no joints and a gripper for each arm.
        """
        each, rest = divmod(self.action_width, len(self.arms))
        if rest or each < 2:
            raise ConfigurationError(
                f"action_width {self.action_width} is no joints and a gripper for each of "
                f"{len(self.arms)} arms."
            )
        return PlatformJoints(
            kind="joint_position",
            joints=each - 1,
            rate_hz=1.0 / self.step_s,
            gripper=self.gripper,
            arms=self.arms,
        )


# Source: OpenVLA-OFT (Kim et al. 2025), platform constants; DT of its ALOHA environment.
CONSTANTS: Mapping[str, Constants] = MappingProxyType(
    {
        "libero": Constants(chunk=8, action_width=7, state="xyz_rotvec_fingers", bounds="q99"),
        "bridge": Constants(chunk=5, action_width=7, state="xyz_rpy_opening", bounds="q99"),
        "aloha": Constants(
            chunk=25,
            action_width=14,
            state="joints",
            bounds="minmax",
            arms=("left", "right"),
            step_s=0.04,
        ),
    }
)
"""Constants by platform."""

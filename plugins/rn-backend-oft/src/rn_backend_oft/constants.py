"""Constants of a training platform, which the checkpoint does not contain: they are options, never
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
    """Constants of one training platform.

    Attributes:
        chunk: actions per inference.
        action_width: values per action.
        state: layout of proprioception.
        bounds: statistics that correspond to -1 and +1.
        arms: names of the arms, on platforms with joint actions; one empty name for one arm.
        gripper: on platforms with joint actions: "open_fraction" 0 closed .. 1 open, or the
            reverse.
        step_s: time between two actions [s] on platforms with joint actions; on others it comes
            from the profile.
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
        """The rows of a platform whose state is "joints".

        Raises:
            ConfigurationError: `action_width` is not the same number of joints and a gripper for
                each arm.
        """
        each, rest = divmod(self.action_width, len(self.arms))
        if rest or each < 2:
            raise ConfigurationError(
                f"action_width {self.action_width} does not hold joints and a gripper for each of "
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

"""Hook of teleoperators, and their descriptor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from roboneuron import Spec, hookspec

GIVES = ("twist", "joint_velocity", "joint_position")
"""Outputs of a teleoperator, in addition to the gripper's opening.

- `twist`: of the TCP [m/s, rad/s], in the base's or the tool's frame.
- `joint_velocity`: by joint [rad/s, m/s of slides].
- `joint_position`: of a leader's joints, by the names of the robot that follows [rad, m].
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class TeleoperatorSpec(Spec):
    """A device or a topic by which a person leads an arm.

    Attributes:
        gives: one of `GIVES`.
        rate_hz: samples a second while the person leads, 30 to 100.
    """

    kind: ClassVar[str] = "teleoperator"
    rules: ClassVar[str] = "rn_standard.teleoperation.contract_cases:KIND"

    gives: str = "twist"
    rate_hz: float = 50.0


@hookspec
def roboneuron_teleoperators() -> Sequence[TeleoperatorSpec]:  # type: ignore[empty-body]
    """Offer devices by which a person leads an arm.

    `target` follows the protocol `rn_standard.teleoperation.samples.Teleoperator`; it is built as
    `target(config, profile)` in the server's process for each lead. It sends nothing to the robot:
    its samples pass the gate and the limits of control.
    """

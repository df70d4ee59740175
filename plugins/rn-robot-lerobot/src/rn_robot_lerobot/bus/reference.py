"""Examples of assembled arms: encoder zeros and calibrations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rn_robot_lerobot.arm import JOINTS, KOCH, LEKIWI, SO101, LerobotArm
from rn_robot_lerobot.calibration import STEPS, MotorCalibration
from rn_robot_lerobot.omni_base import WHEELS

_MIDDLE = STEPS // 2


@dataclass(frozen=True, kw_only=True, slots=True)
class Assembled:
    """One assembled arm.

    Attributes:
        arm: kind of the arm.
        encoder_zeros: encoder step at each joint's position 0, in the order of the motor ids,
            wheels last; arbitrary, because horns can be mounted at any tooth.
        offset_sign: 1 for motors that add their homing offset, -1 for those that subtract it.
        whole_turns: joints whose range is a whole turn.
    """

    arm: LerobotArm
    encoder_zeros: Mapping[str, int]
    offset_sign: int
    whole_turns: tuple[str, ...]

    def calibration(self) -> dict[str, MotorCalibration]:
        """The result of `lerobot-calibrate`: position 0 in the middle, ends at the joints' limits,
        and a whole turn for some joints.
        """
        found = {}
        ends = dict(zip(self.encoder_zeros, self.arm.ends_rad(), strict=False))
        for number, (name, zero) in enumerate(self.encoder_zeros.items(), 1):
            is_whole = name in self.whole_turns or name not in ends
            low, high = (0, STEPS - 1) if is_whole else map(_step, ends[name])
            found[name] = MotorCalibration(
                id=number,
                drive_mode=0,
                homing_offset=self.offset_sign * (_MIDDLE - zero) if name in ends else 0,
                range_min=low,
                range_max=high,
            )
        return found

    def start_rad(self) -> np.ndarray:
        """Start positions of the joints, in the order of the motor ids [rad]."""
        arm = self.arm.start_rad()
        return np.append(arm, np.zeros(len(self.encoder_zeros) - len(arm)))


def _step(position_rad: float) -> int:
    return round(_MIDDLE + position_rad * STEPS / (2.0 * math.pi))


ASSEMBLED_SO101 = Assembled(
    arm=SO101,
    encoder_zeros=dict(zip(JOINTS, (1911, 2304, 2999, 2048, 1500, 2710), strict=True)),
    offset_sign=-1,
    whole_turns=("wrist_roll",),
)
ASSEMBLED_KOCH = Assembled(
    arm=KOCH,
    encoder_zeros=dict(zip(JOINTS, (1024, 2890, 1100, 3050, 2048, 1700), strict=True)),
    offset_sign=1,
    whole_turns=("shoulder_pan", "wrist_roll"),
)
ASSEMBLED_LEKIWI = Assembled(
    arm=LEKIWI,
    encoder_zeros={
        **{f"arm_{name}": zero for name, zero in ASSEMBLED_SO101.encoder_zeros.items()},
        **dict.fromkeys(WHEELS, 0),
    },
    offset_sign=-1,
    whole_turns=("arm_wrist_roll",),
)

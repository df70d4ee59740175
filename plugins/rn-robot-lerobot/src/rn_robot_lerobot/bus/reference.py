"""Arms as they might have been put together: where their encoders are, and their calibrations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from rn_robot_lerobot.arm import JOINTS, KOCH, SO101, LerobotArm
from rn_robot_lerobot.calibration import STEPS, MotorCalibration

_MIDDLE = STEPS // 2


@dataclass(frozen=True, kw_only=True, slots=True)
class Assembled:
    """One arm.

    Attributes:
        arm: what it is.
        encoder_zeros: step of each encoder at the joint's position 0, in the order of the motors'
            numbers: horns are put on at any tooth.
        offset_sign: 1 for motors that add their homing offset, -1 for those that subtract it.
        whole_turns: joints whose range is a whole turn.
    """

    arm: LerobotArm
    encoder_zeros: Mapping[str, int]
    offset_sign: int
    whole_turns: tuple[str, ...]

    def calibration(self) -> dict[str, MotorCalibration]:
        """What `lerobot-calibrate` finds: position 0 in the middle, ends at the joints' limits, and
        a whole turn for some joints.
        """
        found = {}
        ends = zip(self.encoder_zeros.items(), self.arm.ends_rad(), strict=True)
        for number, ((name, zero), (low, high)) in enumerate(ends, 1):
            is_whole = name in self.whole_turns
            found[name] = MotorCalibration(
                id=number,
                drive_mode=0,
                homing_offset=self.offset_sign * (_MIDDLE - zero),
                range_min=0 if is_whole else _step(low),
                range_max=STEPS - 1 if is_whole else _step(high),
            )
        return found


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

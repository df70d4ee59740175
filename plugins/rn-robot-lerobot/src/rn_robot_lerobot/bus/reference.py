"""An SO-101 as it might have been put together: where its encoders are, and its calibration."""

from __future__ import annotations

import math

from rn_robot_lerobot.arm import JAW_CLOSED_RAD, JAW_OPEN_RAD, JOINTS, LOWER_RAD, UPPER_RAD
from rn_robot_lerobot.calibration import STEPS, MotorCalibration

ENCODER_ZEROS = dict(zip(JOINTS, (1911, 2304, 2999, 2048, 1500, 2710), strict=True))
"""Step of each encoder at the joint's position 0: horns are put on at any tooth."""
_MIDDLE = STEPS // 2


def _step(position_rad: float) -> int:
    return round(_MIDDLE + position_rad * STEPS / (2.0 * math.pi))


def reference_calibration() -> dict[str, MotorCalibration]:
    """What `lerobot-calibrate` finds for it: position 0 in the middle, ends at the joints' limits,
    and a whole turn for the wrist's roll.
    """
    ends = [(_step(low), _step(high)) for low, high in zip(LOWER_RAD, UPPER_RAD, strict=True)]
    ends[-1] = (0, STEPS - 1)
    ends.append((_step(JAW_CLOSED_RAD), _step(JAW_OPEN_RAD)))
    return {
        name: MotorCalibration(
            id=number,
            drive_mode=0,
            homing_offset=ENCODER_ZEROS[name] - _MIDDLE,
            range_min=low,
            range_max=high,
        )
        for number, (name, (low, high)) in enumerate(zip(JOINTS, ends, strict=True), 1)
    }

"""An SO-101 and a Koch arm as they might have been put together: where their encoders are, and
their calibrations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from rn_robot_lerobot import arm as so101
from rn_robot_lerobot import koch
from rn_robot_lerobot.calibration import STEPS, MotorCalibration

ENCODER_ZEROS = dict(zip(so101.JOINTS, (1911, 2304, 2999, 2048, 1500, 2710), strict=True))
"""Step of each encoder of the SO-101 at the joint's position 0: horns are put on at any tooth."""
KOCH_ENCODER_ZEROS = dict(zip(koch.JOINTS, (1024, 2890, 1100, 3050, 2048, 1700), strict=True))
_MIDDLE = STEPS // 2


def _step(position_rad: float) -> int:
    return round(_MIDDLE + position_rad * STEPS / (2.0 * math.pi))


def _calibration(
    ends_rad: Sequence[tuple[float, float]],
    whole_turns: Sequence[str],
    offsets: Mapping[str, int],
) -> dict[str, MotorCalibration]:
    """What `lerobot-calibrate` finds: position 0 in the middle, ends at the joints' limits, and a
    whole turn for some joints.
    """
    found = {}
    for number, (name, (low, high)) in enumerate(zip(offsets, ends_rad, strict=True), 1):
        is_whole = name in whole_turns
        found[name] = MotorCalibration(
            id=number,
            drive_mode=0,
            homing_offset=offsets[name],
            range_min=0 if is_whole else _step(low),
            range_max=STEPS - 1 if is_whole else _step(high),
        )
    return found


def reference_calibration() -> dict[str, MotorCalibration]:
    """The SO-101's, whose motors subtract their offset."""
    ends = [
        *zip(so101.LOWER_RAD, so101.UPPER_RAD, strict=True),
        (so101.JAW_CLOSED_RAD, so101.JAW_OPEN_RAD),
    ]
    offsets = {name: zero - _MIDDLE for name, zero in ENCODER_ZEROS.items()}
    return _calibration(ends, ("wrist_roll",), offsets)


def koch_calibration() -> dict[str, MotorCalibration]:
    """The Koch arm's, whose motors add their offset."""
    ends = [
        *zip(koch.LOWER_RAD, koch.UPPER_RAD, strict=True),
        (koch.JAW_CLOSED_RAD, koch.JAW_OPEN_RAD),
    ]
    offsets = {name: _MIDDLE - zero for name, zero in KOCH_ENCODER_ZEROS.items()}
    return _calibration(ends, ("shoulder_pan", "wrist_roll"), offsets)

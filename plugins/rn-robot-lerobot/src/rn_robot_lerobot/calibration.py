"""LeRobot's calibration files: `calibration/robots/<robot>/<id>.json`, one entry per motor.

Read-only: lerobot reads the file again; this module checks it first, so that an error is one
sentence and no arm moves.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from roboneuron import (
    ConfigurationError,
    ForeignDataError,
    foreign,
)

STEPS = 4096
"""Encoder steps per turn."""
_FIELDS = ("id", "drive_mode", "homing_offset", "range_min", "range_max")


@dataclass(frozen=True, kw_only=True, slots=True)
class MotorCalibration:
    """Calibration of one motor.

    Attributes:
        id: id on the bus.
        drive_mode: 1 if it is inverted.
        homing_offset: steps subtracted from the encoder's.
        range_min, range_max: ends of its range, in steps after the offset.
    """

    id: int
    drive_mode: int
    homing_offset: int
    range_min: int
    range_max: int

    @property
    def half_range_rad(self) -> float:
        """Half of its range [rad]; LeRobot counts 4095 steps per turn."""
        return (self.range_max - self.range_min) / (STEPS - 1) * math.pi


def read_calibration(
    path: Path, motors: Collection[str], calibrate: str
) -> dict[str, MotorCalibration]:
    """Read the calibration from a file.

    Args:
        path: path of the file.
        motors: names of the required motors.
        calibrate: command that creates the file.

    Raises:
        ConfigurationError: there is no file, it is damaged, a motor is missing or unknown, or a
            range is invalid.
    """
    hint = f"Make it with: {calibrate}"
    try:
        told = foreign.read_json(path)
    except FileNotFoundError as error:
        raise ConfigurationError(f"There is no calibration {path}.", hint=hint) from error
    except ForeignDataError as error:
        raise ConfigurationError(f"The calibration {path} cannot be read: {error}.") from error
    if not isinstance(told, dict):
        raise ConfigurationError(f"The calibration {path} holds no motors.", hint=hint)
    unknown = [name for name in told if name not in motors]
    absent = [name for name in motors if name not in told]
    if unknown or absent:
        what = f"names the unknown motor {unknown[0]!r}" if unknown else f"lacks {absent[0]!r}"
        raise ConfigurationError(
            f"The calibration {path} {what}; expected {', '.join(motors)}.", hint=hint
        )
    return {name: _motor(path, name, told[name], hint) for name in motors}


def _motor(path: Path, name: str, facts: object, hint: str) -> MotorCalibration:
    if not isinstance(facts, Mapping) or set(facts) != set(_FIELDS):
        raise ConfigurationError(
            f"Motor {name!r} of the calibration {path} does not have {', '.join(_FIELDS)}.",
            hint=hint,
        )
    values = [facts[field] for field in _FIELDS]
    if not all(isinstance(value, int) and not isinstance(value, bool) for value in values):
        raise ConfigurationError(
            f"Motor {name!r} of the calibration {path} has {values}, expected whole numbers."
        )
    found = MotorCalibration(**dict(zip(_FIELDS, values, strict=True)))
    if not 0 <= found.range_min < found.range_max < STEPS:
        raise ConfigurationError(
            f"The range of motor {name!r} in the calibration {path} is {found.range_min}.."
            f"{found.range_max}, expected one within 0..{STEPS - 1}.",
            hint=hint,
        )
    return found

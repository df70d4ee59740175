"""Tool get_<name> for a BatteryState: the charge in plain units; unmeasured values are null."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pydantic import Field

from roboneuron.server.tool import Result
from roboneuron.tools.ros.newest import GetNewest

if TYPE_CHECKING:
    from sensor_msgs.msg import BatteryState

BATTERY = "sensor_msgs/msg/BatteryState"


class Battery(Result):
    """The state of a battery; unmeasured values are null."""

    robot: str
    charge: float | None = Field(description="0 empty .. 1 full")
    status: str = Field(description="charging, discharging, not_charging, full, unknown")
    health: str
    technology: str
    present: bool
    voltage_v: float | None
    current_a: float | None = Field(description="negative when it is discharged")
    temperature_c: float | None
    charge_ah: float | None
    capacity_ah: float | None
    age_s: float = Field(description="since it arrived")
    problems: list[str] = Field(description="implausible values")


def battery_of(robot: str, message: BatteryState, arguments: GetNewest, age_s: float) -> Battery:
    """Convert a BatteryState to plain units.

    Args:
        robot: name of the robot.
        message: as received.
        arguments: arguments of the call.
        age_s: time since its arrival [s].
    """
    problems: list[str] = []
    charge = _number(message.percentage)
    if charge is not None and not 0.0 <= charge <= 1.0:
        problems.append(f"percentage is {charge:g}, the definition says 0 .. 1")
        charge = None
    return Battery(
        robot=robot,
        charge=charge,
        status=_name(message, "power_supply_status", problems),
        health=_name(message, "power_supply_health", problems),
        technology=_name(message, "power_supply_technology", problems),
        present=message.present,
        voltage_v=_number(message.voltage),
        current_a=_number(message.current),
        temperature_c=_number(message.temperature),
        charge_ah=_number(message.charge),
        capacity_ah=_number(message.capacity),
        age_s=round(age_s, 3),
        problems=problems,
    )


def _number(value: float) -> float | None:
    """Round a number to five digits; None for infinities and for NaN, which in a BatteryState means
    "not measured".
    """
    return float(f"{value:.5g}") if math.isfinite(value) else None


def _name(message: object, field: str, problems: list[str]) -> str:
    """Name of a field's constant: 1 is "charging"."""
    prefix, value = f"{field.upper()}_", getattr(message, field)
    for name in dir(type(message)):
        if name.startswith(prefix) and getattr(type(message), name) == value:
            return name.removeprefix(prefix).lower()
    problems.append(f"{field} is {value}, which has no name")
    return str(value)

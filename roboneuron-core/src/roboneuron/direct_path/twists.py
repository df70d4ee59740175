"""Permitted velocities of a mobile base, from its endpoint; used by the gate and the base's
driver.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from roboneuron.contract import Endpoint
from roboneuron.errors import RefusedError

if TYPE_CHECKING:
    from geometry_msgs.msg import Twist

__all__ = ["base_endpoints", "check_twist"]
"""Names that other distributions may use."""

TWIST_FIELDS = ("linear.x", "linear.y", "linear.z", "angular.x", "angular.y", "angular.z")
"""Paths of a geometry_msgs/Twist, in the base frame: forward x, left y, up z [m/s], rotation about
them [rad/s].
"""
_TOLERANCE = 1e-9


def base_endpoints(
    summary: str, bounds: Mapping[str, tuple[float, float]], *, min_turning_radius_m: float = 0.0
) -> tuple[Endpoint, Endpoint]:
    """Create the endpoints `velocity` (a geometry_msgs/Twist in the base frame on cmd_vel) and
    `odometry` (nav_msgs/Odometry on odom) of a mobile base.

    Args:
        summary: description of the base's motion for the agent.
        bounds: lowest and highest value by path of `TWIST_FIELDS`; every other one has to be 0.
        min_turning_radius_m: see `Endpoint`.
    """
    velocity = Endpoint(
        name="velocity",
        kind="publish",
        topic="cmd_vel",
        type="geometry_msgs/msg/Twist",
        summary=f"{summary} It stops by itself when commands cease.",
        bounds=dict.fromkeys(TWIST_FIELDS, (0.0, 0.0)) | dict(bounds),
        rate_hz=50.0,
        stop_message="zero",
        min_turning_radius_m=min_turning_radius_m,
        repeat_hz=10.0,
    )
    odometry = Endpoint(
        name="odometry",
        kind="read",
        topic="odom",
        type="nav_msgs/msg/Odometry",
        summary="Pose since the start by wheel encoders [m, rad], which drifts slowly, and "
        "velocity in the base frame.",
    )
    return velocity, odometry


def check_twist(endpoint: Endpoint, twist: Twist | Mapping[str, float]) -> Mapping[str, float]:
    """Check that the base behind `endpoint` can execute `twist`, and return its values by path.

    Args:
        endpoint: its `bounds` limit each field, its `min_turning_radius_m` the curvature.
        twist: a message, or a value by path, some of TWIST_FIELDS; absent ones are 0.

    Raises:
        RefusedError: a value is not finite or out of bounds, or the turn is sharper than the
            steering allows.
    """
    values = twist if isinstance(twist, Mapping) else _fields_of(twist)
    for path, value in values.items():
        if not math.isfinite(value):
            raise RefusedError(
                f"{path} is {value}, expected a finite number; nothing was sent to "
                f"{endpoint.name!r}."
            )
        low, high = endpoint.bounds.get(path, (-math.inf, math.inf))
        if low == high == 0.0 and value != 0.0:
            raise RefusedError(
                f"{path} is {value:g}, expected 0: the base cannot move along or about this axis."
            )
        if not low <= value <= high:
            raise RefusedError(
                f"{path} is {value:g}, expected {low:g} .. {high:g}: beyond the limits of the base."
            )
    _check_radius(
        endpoint.min_turning_radius_m, values.get("linear.x", 0.0), values.get("angular.z", 0.0)
    )
    return values


def _fields_of(twist: Twist) -> dict[str, float]:
    linear, angular = twist.linear, twist.angular
    values = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
    return dict(zip(TWIST_FIELDS, map(float, values), strict=True))


def _check_radius(radius_m: float, linear_m_s: float, angular_rad_s: float) -> None:
    if radius_m <= 0.0 or angular_rad_s == 0.0:
        return
    if linear_m_s == 0.0:
        raise RefusedError(
            f"angular.z is {angular_rad_s:g} with linear.x 0: the base steers like a car and "
            "cannot turn on the spot.",
            hint="Drive while turning; |linear.x| must be at least "
            f"{radius_m * abs(angular_rad_s):g} for this turn.",
        )
    wanted_m = abs(linear_m_s / angular_rad_s)
    if wanted_m < radius_m * (1.0 - _TOLERANCE):
        raise RefusedError(
            f"linear.x {linear_m_s:g} with angular.z {angular_rad_s:g} is a turn of radius "
            f"{wanted_m:.3g} m, "
            f"expected at least {radius_m:g} m: the steering ends there.",
            hint=f"Turn at {abs(linear_m_s) / radius_m:.3g} rad/s or less, or drive faster.",
        )

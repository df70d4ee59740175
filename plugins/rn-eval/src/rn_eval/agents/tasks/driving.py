"""Steps with the tools of a mobile base, controlled by its odometry only."""

from __future__ import annotations

import math

import anyio

from rn_eval.agents.client import ToolClient
from roboneuron import NotReadyError

_SPEED_M_S, _TURN_RAD_S = 0.25, 0.6
_ROUNDS = 4
_NEAR_M, _NEAR_RAD = 0.01, 0.02
_SHORTEST_S = 0.1
_COASTS_S = 0.8
"""Time in which the base brakes after the last command."""


async def odometry(tools: ToolClient) -> tuple[float, float, float]:
    """x [m], y [m] and heading [rad] since the start of the base. Raises NotReadyError without
    odometry.
    """
    answer = await tools.must("read_odometry")
    try:
        pose = answer.data["messages"][0]["pose"]["pose"]  # type: ignore[index]
        place, turned = pose["position"], pose["orientation"]
        heading_rad = 2.0 * math.atan2(float(turned["z"]), float(turned["w"]))
        return float(place["x"]), float(place["y"]), heading_rad
    except (KeyError, IndexError, TypeError) as error:
        raise NotReadyError(f"read_odometry has no pose: {str(answer.data)[:200]}") from error


async def start_base(tools: ToolClient) -> None:
    """Start the base unless it runs. Raises NotReadyError."""
    answer = await tools.call("start_robot")
    if not answer.ok and answer.code != "wrong_state":
        raise NotReadyError(f"start_robot: {answer.text}")


async def drive(tools: ToolClient, distance_m: float) -> None:
    """Drive straight on (back if negative), then correct the remaining distance. Raises
    NotReadyError.
    """
    x, y, heading = await odometry(tools)
    for _ in range(_ROUNDS):
        now_x, now_y, _ = await odometry(tools)
        driven = (now_x - x) * math.cos(heading) + (now_y - y) * math.sin(heading)
        left = distance_m - driven
        if abs(left) <= _NEAR_M:
            break
        await _command(tools, math.copysign(_SPEED_M_S, left), 0.0, abs(left) / _SPEED_M_S)


async def turn(tools: ToolClient, angle_rad: float) -> None:
    """Turn on the spot, counter-clockwise, at most half a turn, then correct the remaining angle.
    Raises NotReadyError.
    """
    _, _, begun = await odometry(tools)
    for _ in range(_ROUNDS):
        _, _, now = await odometry(tools)
        left = math.remainder(begun + angle_rad - now, 2.0 * math.pi)
        if abs(left) <= _NEAR_RAD:
            break
        await _command(tools, 0.0, math.copysign(_TURN_RAD_S, left), abs(left) / _TURN_RAD_S)


async def _command(tools: ToolClient, linear: float, angular: float, seconds: float) -> None:
    message = {"linear": {"x": linear}, "angular": {"z": angular}}
    step = {"message": message, "duration_s": round(max(seconds, _SHORTEST_S), 3)}
    await tools.must("publish_velocity_sequence", steps=[step])
    await anyio.sleep(_COASTS_S)

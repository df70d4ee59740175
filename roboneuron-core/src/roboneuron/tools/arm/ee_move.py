"""Arguments and result of move_ee."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from roboneuron.contract import Pose
from roboneuron.contract.arrays import F64
from roboneuron.errors import InvalidInputError
from roboneuron.server.tool import Arguments, Result
from roboneuron.tools.arm.ee_line import Order, difference, remaining, rounded

AXES = ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad")
"""Fields of a move, in the order of its six numbers."""
_FURTHEST_M, _FURTHEST_RAD = 0.5, 1.6
_Delta = Annotated[float, Field(ge=-_FURTHEST_M, le=_FURTHEST_M)]
_Turn = Annotated[float, Field(ge=-_FURTHEST_RAD, le=_FURTHEST_RAD)]


class MoveEndEffector(Arguments):
    """Arguments of move_ee."""

    arm: str = Field(default="", description="Moving arm; the others stay in place.")
    dx_m: _Delta = Field(default=0.0, description="Along x of the base (forwards) [m].")
    dy_m: _Delta = Field(default=0.0, description="Along y of the base (to the left) [m].")
    dz_m: _Delta = Field(default=0.0, description="Along z of the base (up) [m].")
    rx_rad: _Turn = Field(
        default=0.0, description="Rotation vector about the TCP, in axes of the base [rad]."
    )
    ry_rad: _Turn = Field(default=0.0, description="Likewise [rad].")
    rz_rad: _Turn = Field(
        default=0.0, description="Likewise: the yaw, counter-clockwise from above [rad]."
    )
    rz_deg: float = Field(default=0.0, ge=-91.0, le=91.0, description="The yaw in degrees instead.")
    gripper_open: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Opening, 0 closed .. 1 open; as last commanded when omitted.",
    )
    duration_s: float | None = Field(
        default=None, gt=0, description="Time for the move; as fast as allowed when omitted [s]."
    )

    def delta(self) -> F64:
        """Translation [m] and rotation vector [rad] (6,). Raises InvalidInputError for two yaws."""
        values = np.array([getattr(self, name) for name in AXES])
        if self.rz_deg and self.rz_rad:
            raise InvalidInputError("Give rz_rad or rz_deg, not both.", path="rz_deg")
        values[5] += np.radians(self.rz_deg)
        return values


class EndEffectorMove(Result):
    """Measured motion of the arm."""

    robot: str
    arm: str = Field(default="", description="which of several arms")
    asked: dict[str, float] = Field(description="the requested move")
    moved: dict[str, float] = Field(description="the measured move, in the base frame")
    position_m: list[float] = Field(
        description="measured TCP position at the end (simulated: now), base frame"
    )
    error_m: float = Field(description="distance from the target")
    error_rad: float
    sent: int = Field(description="actions")
    duration_s: float = Field(description="taken; of a simulated call that it would take")
    simulated: bool
    allowed: bool
    reason: str
    target_m: list[float] = Field(description="target of the TCP, base frame")
    holding: bool | None = Field(
        default=None, description="the hand holds something; null: unknown"
    )
    lost_on_the_way: bool = False
    max_tcp_speed_m_s: float | None = Field(default=None, description="highest, as measured")
    joint_margin: dict[str, float] = Field(
        default_factory=dict, description="joint nearest to its limit, and how far [rad]"
    )


def ee_answer(
    robot: str,
    arm: str,
    order: Order,
    sent: int,
    duration_s: float,
    start: Pose | None,
    end: Pose | None,
    *,
    allowed: bool = True,
    reason: str = "",
    simulated: bool = False,
) -> EndEffectorMove:
    """The answer to a move from `start` to `end`, as far as these are measured."""
    moved, error = np.zeros(6), np.zeros(6)
    if start is not None and end is not None:
        moved = difference(start, end)
        error = remaining(start, order, 1.0, end)
    here = start if end is None else end
    asked = dict(
        zip(AXES, [*order.translation_m.tolist(), *order.rotation_rad.tolist()], strict=True)
    )
    if order.gripper_open is not None:
        asked["gripper_open"] = order.gripper_open
    return EndEffectorMove(
        robot=robot,
        arm=arm,
        asked=asked,
        moved=dict(zip(AXES, rounded(moved), strict=True)),
        position_m=rounded(here.position_m) if here is not None else [],
        target_m=rounded(start.position_m + order.translation_m) if start is not None else [],
        error_m=round(float(np.linalg.norm(error[:3])), 5),
        error_rad=round(float(np.linalg.norm(error[3:])), 5),
        sent=sent,
        duration_s=round(duration_s, 3),
        simulated=simulated,
        allowed=allowed,
        reason=reason,
    )

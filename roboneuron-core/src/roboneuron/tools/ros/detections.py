"""Tool get_<name> for vision_msgs detections: the output of a detector in plain units, in order of
descending score.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from typing import Any

from pydantic import Field

from roboneuron.server.tool import Result
from roboneuron.tools.ros.newest import GetNewest

FLAT, SPATIAL = "vision_msgs/msg/Detection2DArray", "vision_msgs/msg/Detection3DArray"
_LONGEST = 100
"""Longest name in a result [characters]."""


class GetDetections(GetNewest):
    """Arguments of a detections tool."""

    class_id: str = Field(
        default="", max_length=200, description="Only this class; all of them when empty."
    )
    min_score: float = Field(default=0.0, ge=0, le=1, description="Minimum score.")
    entries: int = Field(default=20, ge=1, le=100, description="Maximum number.")


class Detection(Result):
    """One detected object."""

    class_id: str = Field(description="of the hypothesis with the highest score")
    score: float | None = Field(description="its score, 0 .. 1; null: not given")
    id: str
    center: list[float] = Field(description="of its box: x, y, in space also z")
    size: list[float] = Field(description="of its box along its own axes")
    theta_rad: float | None = Field(description="rotation of a box in an image; null in space")
    quaternion_xyzw: list[float] | None = Field(description="rotation of a box in space; else null")
    frame: str


class Detections(Result):
    """Content of the newest message."""

    robot: str
    unit: str = Field(description="of center and size: px or m")
    frame: str = Field(description="of the message, for center")
    detections: list[Detection] = Field(description="in descending order of score")
    more: int = Field(description="that fit the call and are left out")
    damaged: int = Field(description="left out: numbers that are not finite, or no hypothesis")
    age_s: float = Field(description="of the image, by its stamp; else since its arrival")


def detections_of(robot: str, message: Any, arguments: GetDetections, age_s: float) -> Detections:
    """Convert a Detection2DArray or Detection3DArray to plain units.

    Args:
        robot: name of the robot.
        message: as received.
        arguments: select the detections.
        age_s: time since its arrival [s]; used if the message has no stamp.
    """
    is_flat = type(message).__name__ == "Detection2DArray"
    found = [_read(one, message.header.frame_id, is_flat) for one in message.detections]
    whole = [one for one in found if one is not None]
    fitting = [one for one in whole if _fits(one, arguments)]
    fitting.sort(key=lambda one: -1.0 if one.score is None else one.score, reverse=True)
    stamp_s = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
    return Detections(
        robot=robot,
        unit="px" if is_flat else "m",
        frame=message.header.frame_id[:_LONGEST],
        detections=fitting[: arguments.entries],
        more=max(0, len(fitting) - arguments.entries),
        damaged=len(found) - len(whole),
        age_s=round(time.time() - stamp_s if stamp_s > 0.0 else age_s, 3),
    )


def _fits(detection: Detection, arguments: GetDetections) -> bool:
    if arguments.class_id and detection.class_id != arguments.class_id:
        return False
    return not arguments.min_score or (detection.score or 0.0) >= arguments.min_score


def _read(one: Any, frame: str, is_flat: bool) -> Detection | None:
    """Convert one detection; None for an invalid one."""
    if not one.results:
        return None
    best = max(one.results, key=lambda result: _rank(result.hypothesis.score)).hypothesis
    box = one.bbox
    turn: list[float] | None = None
    if is_flat:
        center = [box.center.position.x, box.center.position.y]
        size = [box.size_x, box.size_y]
        theta: float | None = box.center.theta
    else:
        position, rotation = box.center.position, box.center.orientation
        center = [position.x, position.y, position.z]
        size = [box.size.x, box.size.y, box.size.z]
        turn, theta = [rotation.x, rotation.y, rotation.z, rotation.w], None
    if not all(map(math.isfinite, (*center, *size, *(turn or (theta or 0.0,))))):
        return None
    return Detection(
        class_id=best.class_id[:_LONGEST],
        score=_rounded([best.score])[0] if math.isfinite(best.score) else None,
        id=one.id[:_LONGEST],
        center=_rounded(center),
        size=_rounded(size),
        theta_rad=None if theta is None else round(theta, 4),
        quaternion_xyzw=None if turn is None else _rounded(turn),
        frame=(one.header.frame_id or frame)[:_LONGEST],
    )


def _rank(score: float) -> float:
    return score if math.isfinite(score) else -math.inf


def _rounded(values: Iterable[float]) -> list[float]:
    return [round(float(value), 4) for value in values]

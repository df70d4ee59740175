"""Target places in messages: their required frame and forbidden zones. For bases, whose goals are
poses on a map.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from roboneuron.contract import Endpoint
from roboneuron.direct_path.fields import nested
from roboneuron.direct_path.message_types import (
    MessageName,
    PointStamped,
    PoseStamped,
    Quaternion,
    RosMessage,
    Vector,
)
from roboneuron.direct_path.transforms import Transform, rotation_of
from roboneuron.errors import NotReadyError, RefusedError
from roboneuron.gate.motion.path_limits import LimitError
from roboneuron.server.verdict import Clamp

PLACE_TYPES: tuple[MessageName[PoseStamped | PointStamped], ...] = (
    MessageName("geometry_msgs/msg/PoseStamped"),
    MessageName("geometry_msgs/msg/PointStamped"),
)
"""Messages with a place and its frame."""
FindTransform = Callable[[str, str], Transform]
"""Returns the transform from the second frame to the first; raises NotReadyError."""
_LEAST_NORM, _GREATEST_NORM = 0.99, 1.01
"""Range of quaternion lengths that rounding can explain; nav2 accepts any length and would rotate
wrongly.
"""


def to_frame(endpoint: Endpoint, message: RosMessage, find: FindTransform) -> list[Clamp]:
    """Convert every place in a message, at any depth, to the frame of the endpoint with the present
    transforms, so that the checked message is the sent one.

    Returns:
        The changed coordinates [m].

    Raises:
        LimitError: of the limit "frame": a transform is unknown, old, or invalid.
    """
    changes: list[Clamp] = []
    for path, place in nested(message, PLACE_TYPES):
        source = place.header.frame_id
        if not source or source == endpoint.frame:
            continue
        try:
            found = find(endpoint.frame, source)
        except NotReadyError as error:
            raise LimitError("frame", f"{path}header.frame_id: {error.message}") from error
        if hasattr(place, "pose"):
            turn(place.pose.orientation, found, f"{path}pose.orientation")
            changes += shift(place.pose.position, found, f"{path}pose.position")
        else:
            changes += shift(place.point, found, f"{path}point")
        place.header.frame_id = endpoint.frame
    return changes


def turn(rotation: Quaternion, found: Transform, path: str) -> None:
    """Convert a quaternion to the target frame of a transform. Raises as `check_rotation`."""
    check_rotation(path, rotation)
    turned = Transform(
        rotation=found.rotation @ rotation_of(rotation), translation_m=found.translation_m
    )
    rotation.x, rotation.y, rotation.z, rotation.w = turned.quaternion_xyzw.tolist()


def shift(point: Vector, found: Transform, path: str) -> list[Clamp]:
    """Convert a point to the target frame of a transform; return the changes."""
    before = (float(point.x), float(point.y), float(point.z))
    point.x, point.y, point.z = (found.rotation @ np.array(before) + found.translation_m).tolist()
    return [
        Clamp(path=f"{path}.{axis}", asked=asked, sent=getattr(point, axis))
        for axis, asked in zip("xyz", before, strict=True)
    ]


def check_places(endpoint: Endpoint, message: RosMessage) -> None:
    """Check that every place in a message, at any depth, is in the frame of the endpoint and
    outside of its zones.

    Only places are checked; the path is up to the navigation, which must know the zones too.

    Raises:
        LimitError: of the limit "frame" or "zone"; names the place, the requested and the allowed
            value.
    """
    if not endpoint.frame:
        return
    for path, place in nested(message, PLACE_TYPES):
        frame_id = place.header.frame_id
        if frame_id != endpoint.frame:
            raise LimitError(
                "frame",
                f"{path}header.frame_id is {frame_id[:60]!r}, expected {endpoint.frame!r}, in "
                "which the limits of place are.",
            )
        if hasattr(place, "pose"):
            check_rotation(f"{path}pose.orientation", place.pose.orientation)
        for name in zones_at(endpoint, place):
            x, y, z = _position(place)
            raise LimitError(
                "zone",
                f"{path.rstrip('.') or 'The place'} ({x:.2f}, {y:.2f}, {z:.2f}) is in the zone "
                f"{name!r}; nothing may be sent there.",
            )


def check_way(endpoint: Endpoint, feedback: RosMessage) -> None:
    """Raise RefusedError if a place in the feedback of a goal is in a zone of its endpoint. Places
    in other frames are not checked.
    """
    for path, place in nested(feedback, PLACE_TYPES):
        if place.header.frame_id != endpoint.frame:
            continue
        for name in zones_at(endpoint, place):
            raise RefusedError(f"The robot has come into the zone {name!r}, by {path}position.")


def zones_at(endpoint: Endpoint, place: PoseStamped | PointStamped) -> Iterator[str]:
    """Names of the zones that contain a place."""
    position = np.array(_position(place))
    for zone in endpoint.zones:
        if (zone.lower_m <= position).all() and (position <= zone.upper_m).all():
            yield zone.name


def _position(place: PoseStamped | PointStamped) -> tuple[float, float, float]:
    point = place.pose.position if hasattr(place, "pose") else place.point
    return float(point.x), float(point.y), float(point.z)


def check_rotation(path: str, rotation: Quaternion) -> None:
    """Raise LimitError unless a quaternion is a valid rotation; `path` is its location."""
    norm = math.hypot(rotation.x, rotation.y, rotation.z, rotation.w)
    if not _LEAST_NORM <= norm <= _GREATEST_NORM:
        raise LimitError(
            "frame",
            f"{path} has the length {norm:.3g}, expected 1.",
            hint="For a heading of a radians give z = sin(a / 2), w = cos(a / 2).",
        )

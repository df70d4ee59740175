"""Conversion of a motion planner's (MoveIt) constraints to the frame of the arm's limits."""

from __future__ import annotations

from roboneuron.direct_path.fields import nested
from roboneuron.direct_path.message_types import MessageName, RosMessage
from roboneuron.direct_path.places import FindTransform, shift, turn
from roboneuron.direct_path.planner_messages import OrientationConstraint, PositionConstraint
from roboneuron.errors import NotReadyError
from roboneuron.gate.motion.path_limits import LimitError
from roboneuron.server.motion_gate import Clamp

_CONSTRAINTS: tuple[MessageName[PositionConstraint | OrientationConstraint], ...] = (
    MessageName("moveit_msgs/msg/PositionConstraint"),
    MessageName("moveit_msgs/msg/OrientationConstraint"),
)


def constraints_to_frame(message: RosMessage, base_link: str, find: FindTransform) -> list[Clamp]:
    """Convert the constraints of position and orientation in a message to the frame of the arm's
    base with the present transforms, so that the checked message is the sent one.

    Returns:
        The changed coordinates [m].

    Raises:
        LimitError: of the limit "frame": a transform is unknown, old, or invalid.
    """
    changes: list[Clamp] = []
    for path, part in nested(message, _CONSTRAINTS):
        source = part.header.frame_id
        if not source or source == base_link:
            continue
        try:
            found = find(base_link, source)
        except NotReadyError as error:
            raise LimitError("frame", f"{path}header.frame_id: {error.message}") from error
        if hasattr(part, "orientation"):
            turn(part.orientation, found, f"{path}orientation")
        else:
            for index, pose in enumerate(part.constraint_region.primitive_poses):
                where = f"{path}constraint_region.primitive_poses[{index}]"
                turn(pose.orientation, found, f"{where}.orientation")
                changes += shift(pose.position, found, f"{where}.position")
        part.header.frame_id = base_link
    return changes

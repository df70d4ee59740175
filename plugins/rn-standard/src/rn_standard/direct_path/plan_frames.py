"""Constraints of a motion planner (MoveIt) in the frame that the limits of an arm are in."""

from __future__ import annotations

from typing import Any

from rn_standard.direct_path.fields import nested
from rn_standard.direct_path.path_limits import LimitError
from rn_standard.direct_path.places import FindTransform, shift, turn
from roboneuron import NotReadyError
from roboneuron.feature import Clamp

_POSITION, _ORIENTATION = (
    f"moveit_msgs/msg/{kind}Constraint" for kind in ("Position", "Orientation")
)


def constraints_to_frame(message: Any, base_link: str, find: FindTransform) -> list[Clamp]:
    """Have the constraints of position and orientation in a message in the frame of the arm's base,
    by what transforms say now; what is judged is then what is sent.

    Returns:
        The coordinates that were changed [m].

    Raises:
        LimitError: of the limit "frame": a transform is unknown, old, or none.
    """
    changes: list[Clamp] = []
    for path, part in nested(message, (_POSITION, _ORIENTATION)):
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

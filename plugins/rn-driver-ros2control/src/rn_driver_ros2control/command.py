"""Validation of joint commands before sending. Pure computation."""

from __future__ import annotations

import numpy as np

from roboneuron import InvalidInputError, JointCommand, RobotProfile


def checked(command: JointCommand, profile: RobotProfile) -> dict[str, float]:
    """Return positions by joint.

    Raises:
        InvalidInputError: unknown joints, a duplicate, none, unequal lengths, no duration, a
            non-finite value.
    """
    gripper = profile.gripper
    known = {*profile.arm_joints, *(() if gripper is None else (gripper.joint,))}
    unknown = [name for name in command.names if name not in known]
    if unknown or len(set(command.names)) != len(command.names) or not command.names:
        asked = ", ".join(command.names) or "no joint"
        raise InvalidInputError(
            f"A command is for {asked}; known are {', '.join(sorted(known))}, once each."
        )
    if command.position.shape != (len(command.names),) or not np.isfinite(command.position).all():
        raise InvalidInputError(
            f"A command for {len(command.names)} joints holds {command.position.tolist()}."
        )
    if not np.isfinite(command.duration_s) or command.duration_s <= 0.0:
        raise InvalidInputError(f"A command lasts {command.duration_s} s, expected more than 0.")
    return dict(zip(command.names, command.position.tolist(), strict=True))

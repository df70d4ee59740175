"""Checks of a joint command before it is sent to the arm, simulated or real. Pure computation."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from roboneuron import InvalidInputError, JointCommand


def checked(command: JointCommand, known: Collection[str]) -> dict[str, float]:
    """Return the positions by joint after checking the command.

    Raises:
        InvalidInputError: an unknown or repeated joint, no joint, a wrong size, a non-finite value,
            a duration <= 0.
    """
    unknown = [name for name in command.names if name not in known]
    if unknown:
        raise InvalidInputError(
            f"Joint {unknown[0]!r} is not known, expected some of {', '.join(known)}."
        )
    if not command.names or len(set(command.names)) != len(command.names):
        raise InvalidInputError(
            f"Joint names are {list(command.names)}, expected at least one and each only once."
        )
    if command.position.shape != (len(command.names),):
        raise InvalidInputError(
            f"Positions have shape {command.position.shape}, expected ({len(command.names)},): "
            "one per joint name."
        )
    if not np.isfinite(command.position).all():
        bad = command.names[int(np.argmin(np.isfinite(command.position)))]
        raise InvalidInputError(f"The position of {bad!r} is not finite; nothing was sent.")
    if not (np.isfinite(command.duration_s) and command.duration_s > 0.0):
        raise InvalidInputError(
            f"duration_s is {command.duration_s}, expected a finite number of seconds > 0."
        )
    return dict(zip(command.names, command.position.tolist(), strict=True))

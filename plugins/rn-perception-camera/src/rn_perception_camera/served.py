"""Check that the requested cameras have options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

from roboneuron import CameraProfile, ConfigurationError

O = TypeVar("O")  # noqa: E741


def check_cameras(source: str, cameras: Sequence[CameraProfile], options: Mapping[str, O]) -> None:
    """Raise ConfigurationError if there is no camera to serve, or one without options."""
    missing = [camera.name for camera in cameras if camera.name not in options]
    if not cameras:
        raise ConfigurationError(f"The source {source!r} was given no camera to serve.")
    if missing:
        given = ", ".join(map(repr, options)) or "none"
        raise ConfigurationError(
            f"The robot's camera {missing[0]!r} has no table "
            f"[plugins.{source}.cameras.{missing[0]}];"
            f" there are tables for: {given}.",
            hint="Add it, or name the cameras to serve in [perception] cameras.",
        )

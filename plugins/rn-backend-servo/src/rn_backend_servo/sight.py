"""Search for the named cube in all cameras, and choice of the best view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_backend_servo.options import ServoOptions
from roboneuron import CameraView, Frame, UngroundedError
from roboneuron.sight.cube import CubeEstimate
from roboneuron.sight.segmentation import visible_colours

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class Sighting:
    """The named cube in the best camera.

    Attributes:
        role: the camera's role.
        estimate: estimated pose of the cube.
    """

    role: str
    estimate: CubeEstimate


def look(
    frames: Mapping[str, Frame],
    T_base_tcp: Mapping[str, F64 | None],
    colour: str,
    options: ServoOptions,
) -> Sighting | None:
    """Find the cube of `colour`; None if no camera shows it.

    A clear view is preferred to a partial one, the wrist camera to a fixed one.

    Args:
        frames: images by role.
        T_base_tcp: TCP pose of the camera's arm at the time of each image, by role; None skips
            cameras on a TCP.
        colour: key of `segmentation.HUES_DEG`.
        options: height of the table and size of the cubes.
    """
    best: Sighting | None = None
    best_rank = (False, False)
    for role, frame in frames.items():
        calibration, tcp = frame.calibration, T_base_tcp[role]
        if calibration is None or (calibration.arm is not None and tcp is None):
            continue
        view = CameraView.of(calibration, np.eye(4) if tcp is None else tcp)
        estimate = CubeEstimate.of_colour(
            frame.image,
            colour,
            view,
            table_m=options.table_m,
            edge_m=options.edge_m,
            edge_spread_m=options.edge_spread_m,
        )
        if estimate is None:
            continue
        rank = (estimate.is_clear, calibration.arm is not None)
        if best is None or rank > best_rank:
            best, best_rank = Sighting(role=role, estimate=estimate), rank
    return best


def not_visible(frames: Mapping[str, Frame], colour: str) -> UngroundedError:
    """The error that no cube of `colour` is visible, with the visible colours."""
    seen = list(
        dict.fromkeys(name for frame in frames.values() for name in visible_colours(frame.image))
    )
    return UngroundedError(
        f"No {colour} cube is visible in "
        f"{', '.join(repr(frame.camera) for frame in frames.values())}.",
        hint=f"Visible colours: {', '.join(seen) or 'none'}.",
    )

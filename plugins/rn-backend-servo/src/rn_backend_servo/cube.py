"""Measurement of a cube on the table from its outline in one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_backend_servo.geometry import CameraView
from rn_backend_servo.segmentation import Blob

F64 = NDArray[np.float64]

_DIRECTIONS = 24
_HALF_PIXEL = 0.35
"""Distance of outlines from the centres of their outermost pixels, on average over all directions
[px].
"""
_STARTS_RAD = tuple(np.deg2rad([0.0, 22.5, 45.0, 67.5]))
_ITERATIONS = 8
_NUDGES = np.array([1e-4, 1e-4, 1e-3, 1e-4])
"""Steps of the numerical derivatives by x, y [m], yaw [rad] and edge [m]."""
_DAMPING = np.array([1.0, 1.0, 0.1, 1.0])
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
_POOR_PX, _POOR_SHARE = 0.9, 0.05
"""Misfit, absolute [px] and relative to the outline's size, above which a cube is partly hidden or
is no cube.
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class CubeEstimate:
    """Position of a cube, estimated from one image.

    Attributes:
        x_m, y_m: its centre in the base frame.
        yaw_rad: direction of one of its faces about the vertical; quarter turns are equivalent.
        edge_m: length of its edges.
        misfit_px: root mean square distance between its outline and the model's.
        is_clear: the outline is that of a whole cube: the estimate is good enough to grasp.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    edge_m: float
    misfit_px: float
    is_clear: bool


def cube_corners(parameters: F64, table_m: float) -> F64:
    """Corners (..., 8, 3) in the base frame of cubes on the table; parameters (..., 4): x, y, yaw,
    edge.
    """
    x, y, yaw, edge = (parameters[..., i, None] for i in range(4))
    c, s = np.cos(yaw), np.sin(yaw)
    ahead, left, up = (edge * _CORNERS[:, i] for i in range(3))
    return np.stack([x + c * ahead - s * left, y + s * ahead + c * left, table_m + up], axis=-1)


class _OutlineFit:
    """Gauss-Newton on the differences between a cube's outline and the measured one, for several
    start values at once.
    """

    def __init__(
        self, pixels: F64, view: CameraView, table_m: float, edge_m: float, edge_spread_m: float
    ) -> None:
        angles = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
        self._normals = np.stack([np.cos(angles), np.sin(angles)])
        self._seen = (pixels @ self._normals).max(axis=0) + _HALF_PIXEL
        self._view, self._table_m = view, table_m
        self._edge_m, self._edge_spread_m = edge_m, edge_spread_m

    def residuals(self, parameters: F64) -> F64:
        """Differences of the outlines in each direction [px] for parameters (..., 4), then the
        prior's residual.
        """
        reach = (self._view.project(cube_corners(parameters, self._table_m)) @ self._normals).max(
            axis=-2
        )
        prior = (parameters[..., 3:] - self._edge_m) / self._edge_spread_m
        return np.concatenate([reach - self._seen, prior], axis=-1)

    def solve(self, starts: F64) -> tuple[F64, F64]:
        """Best parameters (4,) and their residuals, from starts (k, 4)."""
        parameters = starts
        errors = self.residuals(parameters)
        for _ in range(_ITERATIONS):
            nudged = self.residuals(parameters[:, None, :] + np.diag(_NUDGES))
            jacobian = np.swapaxes((nudged - errors[:, None, :]) / _NUDGES[:, None], 1, 2)
            transposed = np.swapaxes(jacobian, 1, 2)
            step = np.linalg.solve(
                transposed @ jacobian + np.diag(_DAMPING), -(transposed @ errors[:, :, None])
            )[:, :, 0]
            moved = self.residuals(parameters + step)
            better = (moved**2).sum(axis=1) < (errors**2).sum(axis=1)
            parameters = np.where(better[:, None], parameters + step, parameters)
            errors = np.where(better[:, None], moved, errors)
            if not better.any():
                break
        best = int(np.argmin((errors**2).sum(axis=1)))
        return parameters[best], errors[best]


def measure_cube(
    blob: Blob, view: CameraView, *, table_m: float, edge_m: float, edge_spread_m: float
) -> CubeEstimate | None:
    """Fit a cube that stands on the table to the outline of `blob`; None if the blob cannot be on
    the table.

    Position, yaw and edge are chosen so that the projected cube extends as far as the blob in every
    direction of the image (equal support functions), starting from four yaw angles, with the usual
    edge as prior.
    """
    centre = view.meet_plane(blob.centre, table_m + edge_m / 2)
    if centre is None:
        return None
    fit = _OutlineFit(blob.pixels, view, table_m, edge_m, edge_spread_m)
    starts = np.array([[centre[0], centre[1], yaw, edge_m] for yaw in _STARTS_RAD])
    if not np.isfinite(fit.residuals(starts)).all():
        return None
    parameters, errors = fit.solve(starts)
    if not np.isfinite(errors).all():
        return None
    misfit_px = float(np.sqrt(np.mean(errors[:-1] ** 2)))
    size_px = float(np.sqrt(blob.area_px))
    is_whole = (
        not blob.is_cut
        and misfit_px <= max(_POOR_PX, _POOR_SHARE * size_px)
        and abs(errors[-1]) <= 3.0
    )
    return CubeEstimate(
        x_m=float(parameters[0]),
        y_m=float(parameters[1]),
        yaw_rad=float(parameters[2]),
        edge_m=float(parameters[3]),
        misfit_px=misfit_px,
        is_clear=is_whole,
    )

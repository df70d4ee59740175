"""Measurement of a cube on the table from its outline in one image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract.arrays import F64
from roboneuron.contract.camera_view import CameraView
from roboneuron.sight.segmentation import Blob, find_blob

__all__ = ["CubeEstimate", "cube_corners"]
"""Names that other distributions may use."""


_DIRECTIONS = 24
_HALF_PIXEL = 0.35
"""Distance of outlines from the centres of their outermost pixels, on average over all directions
[px].
"""
_STARTS_RAD = tuple(np.deg2rad([0.0, 22.5, 45.0, 67.5]))
_ITERATIONS = 8
_NUDGES = np.array([1e-4, 1e-4, 1e-3, 1e-4, 1e-4])
"""Steps of the numerical derivatives by x, y [m], yaw [rad], edge and bottom [m]."""
_DAMPING = np.array([1.0, 1.0, 0.1, 1.0, 1.0])
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
MOST_SPREADS = 3.0
"""Largest deviation of an edge from the usual one, in typical deviations."""
PIXEL_PX = 0.4
"""Typical error of an outline in one direction; gives the told uncertainty, compared with the
simulator's truth by benchmarks/bench_sight.py.
"""
Outline = tuple[Blob, CameraView]
"""A region, and the camera that sees it."""
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

    @classmethod
    def of_colour(
        cls,
        image: NDArray[np.uint8],
        colour: str,
        view: CameraView,
        *,
        table_m: float,
        edge_m: float,
        edge_spread_m: float,
    ) -> CubeEstimate | None:
        """Measure the cube of a colour in an image, uint8 (height, width, 3), RGB; None if none is
        there.

        Args:
            image: of the camera.
            colour: key of `segmentation.HUES_DEG`.
            view: of the camera.
            table_m, edge_m, edge_spread_m: as of `measure_cube`.
        """
        blob = find_blob(image, colour)
        if blob is None:
            return None
        return measure_cube(blob, view, table_m=table_m, edge_m=edge_m, edge_spread_m=edge_spread_m)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CubeFit:
    """The cube that fits its outlines best.

    Attributes:
        parameters: float64 (4,), x, y [m], yaw [rad], edge [m]; (5,) with the height of its bottom.
        covariance: of the parameters, for errors of `PIXEL_PX` in each direction of each outline.
        misfits_px: root mean square distance of the outlines, of each view.
        edge_spreads: deviation of the edge from the usual one, in typical deviations.
    """

    parameters: F64
    covariance: F64
    misfits_px: tuple[float, ...]
    edge_spreads: float


def cube_corners(parameters: F64, table_m: float) -> F64:
    """Corners (..., 8, 3) in the base frame of cubes; parameters (..., 4): x, y, yaw, edge of cubes
    on the table, (..., 5) with the height of their bottom.
    """
    bottom = table_m if parameters.shape[-1] == 4 else parameters[..., 4, None]
    x, y, yaw, edge = (parameters[..., i, None] for i in range(4))
    c, s = np.cos(yaw), np.sin(yaw)
    ahead, left, up = (edge * _CORNERS[:, i] for i in range(3))
    return np.stack([x + c * ahead - s * left, y + s * ahead + c * left, bottom + up], axis=-1)


class _OutlineFit:
    """Gauss-Newton on the differences between a cube's outlines and the measured ones, for several
    start values at once.
    """

    def __init__(
        self, outlines: Sequence[Outline], table_m: float, edge_m: float, edge_spread_m: float
    ) -> None:
        angles = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
        self._normals = np.stack([np.cos(angles), np.sin(angles)])
        self._seen = [
            (view, (blob.pixels @ self._normals).max(axis=0) + _HALF_PIXEL)
            for blob, view in outlines
        ]
        self._table_m, self._edge_m, self._edge_spread_m = table_m, edge_m, edge_spread_m

    def residuals(self, parameters: F64) -> F64:
        """Differences of the outlines in each direction [px] for parameters (..., 4 or 5), view by
        view, then the prior's residual.
        """
        corners = cube_corners(parameters, self._table_m)
        outlines = [
            (view.project(corners) @ self._normals).max(axis=-2) - seen for view, seen in self._seen
        ]
        prior = (parameters[..., 3:4] - self._edge_m) / self._edge_spread_m
        return np.concatenate([*outlines, prior], axis=-1)

    def jacobian(self, parameters: F64, errors: F64) -> F64:
        """Derivatives (..., residuals, parameters) at `parameters`, whose residuals are
        `errors`.
        """
        nudges = _NUDGES[: parameters.shape[-1]]
        nudged = self.residuals(parameters[..., None, :] + np.diag(nudges))
        return np.swapaxes((nudged - errors[..., None, :]) / nudges[:, None], -2, -1)

    def solve(self, starts: F64) -> tuple[F64, F64]:
        """Best parameters (n,) and their residuals, from starts (k, n)."""
        damping = np.diag(_DAMPING[: starts.shape[-1]])
        parameters = starts
        errors = self.residuals(parameters)
        for _ in range(_ITERATIONS):
            jacobian = self.jacobian(parameters, errors)
            transposed = np.swapaxes(jacobian, 1, 2)
            step = np.linalg.solve(
                transposed @ jacobian + damping, -(transposed @ errors[:, :, None])
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
    fit = _OutlineFit([(blob, view)], table_m, edge_m, edge_spread_m)
    starts = np.array([[centre[0], centre[1], yaw, edge_m] for yaw in _STARTS_RAD])
    if not np.isfinite(fit.residuals(starts)).all():
        return None
    parameters, errors = fit.solve(starts)
    if not np.isfinite(errors).all():
        return None
    misfit_px = float(np.sqrt(np.mean(errors[:-1] ** 2)))
    is_whole = (
        not blob.is_cut and misfit_px <= worst_misfit_px(blob) and abs(errors[-1]) <= MOST_SPREADS
    )
    return CubeEstimate(
        x_m=float(parameters[0]),
        y_m=float(parameters[1]),
        yaw_rad=float(parameters[2]),
        edge_m=float(parameters[3]),
        misfit_px=misfit_px,
        is_clear=is_whole,
    )


def worst_misfit_px(blob: Blob) -> float:
    """Misfit above which a cube is partly hidden or is no cube [px]."""
    return max(_POOR_PX, _POOR_SHARE * float(np.sqrt(blob.area_px)))


def fit_cube(
    outlines: Sequence[Outline],
    start_m: F64,
    *,
    table_m: float,
    edge_m: float,
    edge_spread_m: float,
    is_free: bool,
) -> CubeFit | None:
    """Fit one cube to its outlines in several views; None if it is behind one of them.

    Args:
        outlines: region and camera, at least one.
        start_m: float64 (3,), about its centre in the base frame.
        table_m: height of the table.
        edge_m, edge_spread_m: usual edge, and typical deviation from it.
        is_free: its height is found too, which needs two views; otherwise it is on the table.
    """
    fit = _OutlineFit(outlines, table_m, edge_m, edge_spread_m)
    height = [start_m[2] - edge_m / 2] if is_free else []
    starts = np.array([[start_m[0], start_m[1], yaw, edge_m, *height] for yaw in _STARTS_RAD])
    if not np.isfinite(fit.residuals(starts)).all():
        return None
    parameters, errors = fit.solve(starts)
    if not np.isfinite(errors).all():
        return None
    jacobian = fit.jacobian(parameters, errors)
    weights = np.append(np.full(len(errors) - 1, PIXEL_PX**-2), 1.0)
    information = jacobian.T @ (jacobian * weights[:, None])
    per_view = errors[:-1].reshape(len(outlines), _DIRECTIONS)
    return CubeFit(
        parameters=parameters,
        covariance=np.linalg.pinv(information),
        misfits_px=tuple(np.sqrt(np.mean(per_view**2, axis=1)).tolist()),
        edge_spreads=float(abs(errors[-1])),
    )

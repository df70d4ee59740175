"""Lens distortion: mapping between a camera's image and that of an ideal pinhole camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from roboneuron import ConfigurationError

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]
Model = Literal["plumb_bob", "rational_polynomial", "equidistant"]
Quad = tuple[float, float, float, float, float, float, float, float]

MODELS: dict[str, tuple[int, ...]] = {
    "plumb_bob": (4, 5),
    "rational_polynomial": (5, 8),
    "equidistant": (4,),
}
"""Numbers of coefficients by distortion model of sensor_msgs/CameraInfo."""
CELL_PX = 16
"""Cell size of the map, which is exact at the cells' corners and bilinear in between; the error is
under 0.1 px for a lens with k1 = -0.3.
"""


class Undistortion:
    """Converts to images of a pinhole camera with the same intrinsics; built once per image size.

    Args:
        intrinsics: float64 (3, 3) [px], pixel centres at integers + 0.5.
        model: one of MODELS.
        coefficients: as many as the model has, in the order of OpenCV and ROS.
        width, height: size of the images [px].

    Raises:
        ConfigurationError: an unknown model, or another number of coefficients.
    """

    def __init__(
        self, intrinsics: F64, model: str, coefficients: Sequence[float], *, width: int, height: int
    ) -> None:
        if len(coefficients) not in MODELS.get(model, ()):
            known = "; ".join(
                f"{name}: {' or '.join(map(str, sizes))}" for name, sizes in MODELS.items()
            )
            raise ConfigurationError(
                f"Distortion model {model!r} with {len(coefficients)} coefficients is not known, "
                f"expected {known}."
            )
        self._size = (width, height)
        xs = np.unique(np.append(np.arange(0, width, CELL_PX), width)).astype(np.float64)
        ys = np.unique(np.append(np.arange(0, height, CELL_PX), height)).astype(np.float64)
        u, v = np.meshgrid(xs, ys)
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(intrinsics).T
        x, y = distort(rays[..., 0], rays[..., 1], model, coefficients)
        seen = np.stack([x, y, np.ones_like(x)], axis=-1) @ intrinsics.T
        self._mesh = [
            (
                (int(xs[i]), int(ys[j]), int(xs[i + 1]), int(ys[j + 1])),
                _quad(seen[j, i], seen[j + 1, i], seen[j + 1, i + 1], seen[j, i + 1]),
            )
            for j in range(len(ys) - 1)
            for i in range(len(xs) - 1)
        ]

    def apply(self, image: U8) -> U8:
        """uint8 (H, W, 3) of the lens -> uint8 (H, W, 3) of a pinhole camera; black outside of the
        lens' view.
        """
        picture = Image.fromarray(image)
        return np.asarray(
            picture.transform(
                self._size, Image.Transform.MESH, self._mesh, Image.Resampling.BILINEAR
            )
        )


def distort(x: F64, y: F64, model: str, coefficients: Sequence[float]) -> tuple[F64, F64]:
    """Position of a ray through (x, y, 1) in the normalised image plane of the distorted camera.

    Source: OpenCV 4 documentation, "Camera Calibration and 3D Reconstruction" (radial, tangential
    and rational terms) and "Fisheye camera model" (equidistant); names of the models:
    sensor_msgs/CameraInfo.
    """
    r2 = x * x + y * y
    if model == "equidistant":
        k1, k2, k3, k4 = coefficients
        r = np.sqrt(r2)
        angle = np.arctan(r)
        a2 = angle * angle
        bent = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        scale = np.divide(bent, r, out=np.ones_like(r), where=r > 1e-9)
        return x * scale, y * scale
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *([0.0] * (8 - len(coefficients))))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def _quad(upper_left: F64, lower_left: F64, lower_right: F64, upper_right: F64) -> Quad:
    corners = (upper_left, lower_left, lower_right, upper_right)
    a, b, c, d, e, f, g, h = (float(value) for corner in corners for value in corner[:2])
    return (a, b, c, d, e, f, g, h)

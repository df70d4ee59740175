"""Processing of every image of one camera: undistortion, crop, resize, and the matching
calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rn_perception_camera.fit import Fit, Size, fit, unchanged
from rn_perception_camera.lens import Undistortion
from rn_perception_camera.options import ResizeOptions
from roboneuron import CameraCalibration, CameraProfile, ConfigurationError

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]

HALF_PIXEL = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
"""Offset added to intrinsics of OpenCV and ROS: they put pixel centres at integers, the contract at
integers + 0.5.
"""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Preparation:
    """Processing of images of one size.

    Attributes:
        fit: crop and resize.
        undistortion: undistortion before it; None for none.
        calibration: calibration of the output images; None if unknown.
    """

    fit: Fit
    undistortion: Undistortion | None
    calibration: CameraCalibration | None

    def apply(self, image: U8) -> U8:
        """uint8 (h, w, 3) RGB as captured -> uint8 (H, W, 3) RGB as configured; the same array if
        nothing has to be done.
        """
        if self.undistortion is not None:
            image = self.undistortion.apply(image)
        return self.fit.apply(image)


def prepare(
    profile: CameraProfile,
    size: Size,
    resize: ResizeOptions | None,
    *,
    intrinsics: F64 | None = None,
    undistortion: Undistortion | None = None,
) -> Preparation:
    """Create the processing of images of `size`.

    Args:
        profile: contains the camera's mounting and, if `intrinsics` is None, its calibration at
            this size.
        size: width and height of the input images [px].
        resize: None to keep the size.
        intrinsics: float64 (3, 3) [px] of the input images (after undistortion), pixel centres at
            integers + 0.5.
        undistortion: None for images that need none.
    """
    chosen = (
        unchanged(size) if resize is None else fit(size, (resize.width, resize.height), resize.fit)
    )
    calibration = profile.calibration
    if calibration is not None and intrinsics is not None:
        calibration = replace(calibration, intrinsics=intrinsics)
    elif intrinsics is None:
        calibration = profile.calibration_at(*size)
    if calibration is not None:
        calibration = replace(calibration, intrinsics=chosen.to_intrinsics(calibration.intrinsics))
    return Preparation(fit=chosen, undistortion=undistortion, calibration=calibration)


def measured_undistortion(
    profile: CameraProfile,
    size: Size,
    coefficients: Sequence[float] | None,
    intrinsics: F64 | None = None,
) -> Undistortion | None:
    """Undistortion of images of `size` by the coefficients of an option; None without any.

    Args:
        profile: contains the calibration whose intrinsics count if `intrinsics` is None.
        size: width and height of the images [px].
        coefficients: 4, 5 or 8, in the order of OpenCV.
        intrinsics: float64 (3, 3) [px] of the images, pixel centres at integers + 0.5.

    Raises:
        ConfigurationError: no intrinsics are known for images of this size.
    """
    if coefficients is None or not any(coefficients):
        return None
    known = profile.calibration_at(*size)
    if intrinsics is None and known is not None:
        intrinsics = known.intrinsics
    if intrinsics is None:
        raise ConfigurationError(
            f"Camera {profile.name!r} has distortion coefficients, but no intrinsics of images of "
            f"{size[0]}x{size[1]} pixels.",
            hint=f"Calibrate it at this size: `roboneuron robot cameras calibrate {profile.name}`.",
        )
    model = "rational_polynomial" if len(coefficients) == 8 else "plumb_bob"
    return Undistortion(intrinsics, model, coefficients, width=size[0], height=size[1])

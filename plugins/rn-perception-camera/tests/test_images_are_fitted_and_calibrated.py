"""Crop, letterbox and undistortion move pixels and intrinsics alike; OpenCV is the oracle of lens
models.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from rn_perception_camera.fit import fit
from rn_perception_camera.lens import Undistortion, distort
from rn_perception_camera.options import ResizeOptions
from rn_perception_camera.preparation import HALF_PIXEL, prepare
from roboneuron.errors import ConfigurationError

K = np.array([[50.0, 0, 30.5], [0, 51, 20.5], [0, 0, 1]])
SIDES = st.integers(min_value=1, max_value=400)


def blob(width: int, height: int, u: float, v: float) -> Any:
    """A soft white dot at (u, v) [px, pixel centres at integers + 0.5] on black."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    grey = 255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 4.0**2))
    return np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)


def centre(image: Any) -> tuple[float, float]:
    """Where the dot is [px, pixel centres at integers + 0.5]."""
    weight = image[:, :, 0].astype(float)
    x, y = np.meshgrid(np.arange(image.shape[1]) + 0.5, np.arange(image.shape[0]) + 0.5)
    return float((weight * x).sum() / weight.sum()), float((weight * y).sum() / weight.sum())


@pytest.mark.parametrize("how", ["letterbox", "crop"])
@pytest.mark.parametrize("size", [(224, 224), (96, 160), (64, 64), (320, 180)])
def test_a_dot_lands_where_the_new_intrinsics_say(
    profile: Any, how: Any, size: tuple[int, int]
) -> None:
    u, v = 150.0, 130.0
    intrinsics = np.array([[260.0, 0, 165], [0, 260, 118], [0, 0, 1]])
    resize = ResizeOptions(width=size[0], height=size[1], fit=how)
    preparation = prepare(profile("front"), (320, 240), resize, intrinsics=intrinsics)
    image = preparation.apply(blob(320, 240, u, v))
    assert image.shape == (size[1], size[0], 3)
    assert preparation.calibration is not None
    ray = np.linalg.inv(intrinsics) @ [u, v, 1.0]
    expected = (preparation.calibration.intrinsics @ ray)[:2]
    assert centre(image) == pytest.approx(expected, abs=0.1)  # eight-bit rounding of the dot's rim


def test_letterbox_keeps_all_and_paints_bars_black() -> None:
    white = np.full((48, 64, 3), 255, dtype=np.uint8)
    image = fit((64, 48), (64, 64), "letterbox").apply(white)
    assert (image[8:56] == 255).all()
    assert not image[:8].any()
    assert not image[56:].any()


def test_crop_cuts_the_sides_only() -> None:
    image = np.zeros((48, 64, 3), dtype=np.uint8)
    image[:, 8:56] = 255
    assert (fit((64, 48), (48, 48), "crop").apply(image) == 255).all()


@settings(deadline=None, max_examples=50)  # machines are shared
@given(SIDES, SIDES, SIDES, SIDES, st.sampled_from(["letterbox", "crop"]))
def test_every_size_fits_into_every_other(
    width: int, height: int, wide: int, high: int, how: Any
) -> None:
    chosen = fit((width, height), (wide, high), how)
    left, upper, right, lower = chosen.box
    assert 0 <= left < right <= width
    assert 0 <= upper < lower <= height
    assert 0 <= chosen.offset[0] <= wide - chosen.scaled[0]
    assert 0 <= chosen.offset[1] <= high - chosen.scaled[1]
    image = chosen.apply(np.full((height, width, 3), 7, dtype=np.uint8))
    assert image.shape == (high, wide, 3)


def test_images_of_the_right_size_are_not_copied(pixels: Any) -> None:
    assert fit((64, 48), (64, 48), "crop").apply(pixels) is pixels


@pytest.mark.parametrize(
    "d", [(-0.3, 0.12, 0.002, -0.001, 0.0), (0.4, -0.2, 0.01, 0.0, 0.02, 0.3, -0.1, 0.01)]
)
def test_lens_model_is_opencvs(d: tuple[float, ...]) -> None:
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.6, 0.6, 7))
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    seen, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), np.array(d))
    model = "plumb_bob" if len(d) == 5 else "rational_polynomial"
    ours = np.stack(distort(x.ravel(), y.ravel(), model, d), axis=1)
    np.testing.assert_allclose(ours, seen[:, 0], atol=1e-12)


def test_fisheye_model_is_the_equidistant_one() -> None:
    angle = np.array([0.0, 0.3, 0.9])
    x, y = distort(np.tan(angle), np.zeros(3), "equidistant", (0.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(x, angle, atol=1e-12)
    np.testing.assert_array_equal(y, 0.0)


def test_undistorted_images_are_opencvs() -> None:
    rng = np.random.default_rng(2)
    smooth = cv2.resize(
        rng.integers(0, 256, (15, 20, 3), dtype=np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC
    )
    k = np.array([[240.0, 0, 158.0], [0, 241, 121], [0, 0, 1]])
    d = (-0.3, 0.1, 0.001, -0.002, 0.0)
    expected = cv2.undistort(smooth, k, np.array(d)).astype(int)
    image = (
        Undistortion(k + HALF_PIXEL, "plumb_bob", d, width=320, height=240)
        .apply(smooth)
        .astype(int)
    )
    inner = (slice(20, -20), slice(20, -20))
    difference = np.abs(image - expected)[inner]
    assert difference.mean() < 1.0
    # 0.1 px in a picture that changes by up to 40 a pixel
    assert np.percentile(difference, 99) <= 4
    assert np.abs(smooth.astype(int) - expected)[inner].mean() > 10  # and it was much to do


def test_undistorted_and_resized_images_are_calibrated(
    cell: Any, raw: Any, info: Any, pixels: Any
) -> None:
    resize = {"width": 48, "height": 48, "fit": "crop"}
    source = cell.source(front={"camera_info": "info", "distortion": "undistort", "resize": resize})
    cell.topics.deliver("info", info(d=(-0.2, 0.0, 0.0, 0.0, 0.0)))
    cell.topics.deliver("front", raw(pixels))
    frame = source.read(1.0)
    assert frame.image.shape == (48, 48, 3)
    np.testing.assert_allclose(
        frame.calibration.intrinsics, [[50, 0, 22.5], [0, 51, 20.5], [0, 0, 1]]
    )
    assert (frame.image != pixels[:, 8:56]).any()


def test_wrong_number_of_coefficients_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="plumb_bob' with 3 coefficients"):
        Undistortion(K, "plumb_bob", (0.1, 0.0, 0.0), width=64, height=48)


def test_coefficients_of_the_options_undistort_by_the_intrinsics_of_the_profile(
    cell: Any, raw: Any, info: Any, pixels: Any
) -> None:
    d = (-0.2, 0.05, 0.0, 0.0, 0.0)
    source = cell.source(front={"distortion": list(d)})
    cell.topics.deliver("front", raw(pixels))
    frame = source.read(1.0)
    k = frame.calibration.intrinsics
    assert k[0].tolist() == [
        60.0,
        0.0,
        32.0,
    ]  # the profile's, in front of images without distortion
    expected = Undistortion(k, "plumb_bob", d, width=64, height=48).apply(pixels)
    np.testing.assert_array_equal(frame.image, expected)


def test_coefficients_without_intrinsics_are_refused(cell: Any, raw: Any, pixels: Any) -> None:
    source = cell.source(calibrated=False, front={"distortion": [0.1, 0.0, 0.0, 0.0]})
    cell.topics.deliver("front", raw(pixels))
    with pytest.raises(ConfigurationError, match="no intrinsics"):
        source.read(1.0)


@pytest.mark.parametrize(
    "table",
    [
        {"distortion": [0.1, 0.0, 0.0, 0.0], "camera_info": "info"},
        {"distortion": [0.1, 0.0, 0.0, 0.0], "depth": "depth"},
        {"distortion": [0.1]},
        {"distortion": "undistort"},
        {"distortion": "flatten", "camera_info": "info"},
    ],
)
def test_a_distortion_that_does_not_fit_the_other_options_is_refused(
    cell: Any, table: dict[str, Any]
) -> None:
    with pytest.raises(ValidationError, match="distort"):
        cell.source(front=table)

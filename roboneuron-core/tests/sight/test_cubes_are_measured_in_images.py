"""Segmentation and the outline fit, on painted images whose cubes are known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rn_testing.fakes.painted_table import (
    CUBES,
    TABLE_RGB,
    overhead_camera,
    paint_cubes,
    painted_cubes,
)
from roboneuron import CalibratedImage, CameraView
from roboneuron.sight.colours import ColourLocator
from roboneuron.sight.cube import measure_cube
from roboneuron.sight.segmentation import colour_mask, find_blob, visible_colours

VIEW = CameraView.of(overhead_camera(), np.eye(4))


@given(
    x_m=st.floats(0.35, 0.65),
    y_m=st.floats(-0.25, 0.25),
    yaw_rad=st.floats(-np.pi / 4, np.pi / 4),
    edge_m=st.floats(0.04, 0.048),
)
@settings(max_examples=25, deadline=None)
def test_a_cube_is_found_where_it_was_painted(
    x_m: float, y_m: float, yaw_rad: float, edge_m: float
) -> None:
    blob = find_blob(paint_cubes(overhead_camera(), {"red": (x_m, y_m, yaw_rad)}, edge_m), "red")
    assert blob is not None
    found = measure_cube(blob, VIEW, table_m=0.0, edge_m=0.044, edge_spread_m=0.004)
    assert found is not None
    assert found.is_clear
    assert np.hypot(found.x_m - x_m, found.y_m - y_m) < 0.003  # a pixel is 3.5 mm on the table
    off = (found.yaw_rad - yaw_rad + np.pi / 4) % (np.pi / 2) - np.pi / 4
    assert abs(off) < 0.2  # 12 pixels across: one pixel rotates the outline by 0.08 rad


def test_colours_are_told_apart() -> None:
    image = paint_cubes(
        overhead_camera(),
        {"red": (0.4, 0.1, 0.0), "green": (0.6, 0.1, 0.3), "blue": (0.5, -0.1, 0.5)},
    )
    assert sorted(visible_colours(image)) == ["blue", "green", "red"]
    assert find_blob(image, "yellow") is None


def test_a_compact_region_wins_over_a_larger_one_that_is_thin() -> None:
    image = paint_cubes(overhead_camera(), {"red": (0.5, 0.0, 0.0)})
    for index in range(200):
        image[index, index : index + 4] = (200, 25, 25)  # a red cable has more pixels than the cube
    image[90:140, 90:140] = paint_cubes(overhead_camera(), {"red": (0.5, 0.0, 0.0)})[90:140, 90:140]
    blob = find_blob(image, "red")
    assert blob is not None
    assert np.allclose(blob.centre, VIEW.project(np.array([0.5, 0.0, 0.03])), atol=3)


@pytest.mark.parametrize("colour", ["red", "blue"])
def test_a_cube_cut_by_the_edge_is_not_clear(colour: str) -> None:
    blob = find_blob(paint_cubes(overhead_camera(), {colour: (0.5, 0.4, 0.0)}), colour)
    assert blob is not None
    assert blob.is_cut
    found = measure_cube(blob, VIEW, table_m=0.0, edge_m=0.044, edge_spread_m=0.004)
    assert found is None or not found.is_clear


@pytest.mark.parametrize("cameras", [slice(0, 1), slice(0, 2)], ids=["one", "two"])
def test_cubes_on_a_higher_table_are_found_there(cameras: slice) -> None:
    raised = np.array([0.0, 0.0, 0.3])
    locator = ColourLocator(None)
    locator.load()
    images = painted_cubes()[cameras]
    lifted = []
    for image in images:
        pose = image.T_base_camera.copy()
        pose[:3, 3] += raised
        lifted.append(replace(image, T_base_camera=pose, table_m=0.3))
    low, high = locator.locate(images), locator.locate(lifted)
    assert len(low) == len(high) == len(CUBES)
    for one, other in zip(low, high, strict=True):
        assert other.position_m == pytest.approx(one.position_m + raised, abs=1e-3)


def displaced_images(displaced: str, hidden: str = "") -> list[CalibratedImage]:
    """The painted cubes, whose camera of that name is 2 cm beside its calibration and alone sees
    the cube of the hidden colour.
    """
    images = []
    for image in painted_cubes():
        frame, pose = image.frame, image.T_base_camera.copy()
        if frame.camera == displaced:
            pose[0, 3] += 0.02
        elif hidden:
            pixels = frame.image.copy()
            pixels[colour_mask(pixels, hidden)] = TABLE_RGB
            frame = replace(frame, image=pixels)
        images.append(replace(image, frame=frame, T_base_camera=pose))
    return images


@pytest.mark.parametrize("hidden", ["", "red"])
@pytest.mark.parametrize("displaced", ["above", "side"])
def test_a_camera_that_was_moved_is_told_in_all_uncertainties(displaced: str, hidden: str) -> None:
    locator = ColourLocator(None)
    locator.load()
    found = locator.locate(displaced_images(displaced, hidden))
    assert sorted(one.colour for one in found) == sorted(CUBES)
    for one in found:
        x_m, y_m, _ = CUBES[one.colour]
        off_m = float(np.linalg.norm(one.position_m - [x_m, y_m, 0.022]))
        assert off_m <= one.uncertainty_m
        assert 0.012 < one.uncertainty_m < 0.04

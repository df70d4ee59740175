"""Segmentation and the outline fit, on painted images whose cubes are known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rn_standard.sight.contract_cases import overhead_camera, paint_cubes
from rn_standard.sight.cube import measure_cube
from rn_standard.sight.segmentation import find_blob, visible_colours
from rn_standard.sight.view import CameraView

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

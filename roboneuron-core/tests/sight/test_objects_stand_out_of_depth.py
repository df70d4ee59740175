"""The locator `depth`: boxes on and over the table, what is hidden or cut, holes, noise, a table
that is not where it should be, and what is no object.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rn_testing.fakes.painted_table import SIDE_PX, Box, depth_of, overhead_camera, side_camera
from roboneuron import CalibratedImage, CameraCalibration, Frame, LocatedObject, StateError
from roboneuron.sight.depth import DepthLocator, DepthOptions

F32 = NDArray[np.float32]
CAMERAS = {"above": overhead_camera(), "side": side_camera()}
BOX: Box = (0.5, 0.05, 0.4, 0.08, 0.03, 0.0, 0.05)


def picture(name: str, depth_m: F32 | None) -> CalibratedImage:
    camera: CameraCalibration = CAMERAS[name]
    frame = Frame(
        camera=name,
        image=np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8),
        stamp_ns=1,
        frame_id=name,
        calibration=camera,
        depth_m=depth_m,
    )
    return CalibratedImage(frame=frame, T_base_camera=camera.T_mount_camera)


def found_in(*images: CalibratedImage) -> list[LocatedObject]:
    locator = DepthLocator(None)
    locator.load()
    return list(locator.locate(images))


def seen(*boxes: Box, cameras: tuple[str, ...] = ("above", "side")) -> list[LocatedObject]:
    return found_in(*(picture(name, depth_of(CAMERAS[name], boxes)) for name in cameras))


def off_m(one: LocatedObject, box: Box) -> float:
    return float(np.linalg.norm(one.position_m - [box[0], box[1], (box[5] + box[6]) / 2]))


@pytest.mark.parametrize("cameras", [("above",), ("side",), ("above", "side")])
@pytest.mark.parametrize(
    ("box", "symmetry_rad"),
    [(BOX, np.pi), ((0.45, -0.1, -0.3, 0.05, 0.05, 0.0, 0.12), np.pi / 2)],
    ids=["long", "tall"],
)
def test_a_box_has_its_place_size_and_yaw(
    box: Box, symmetry_rad: float, cameras: tuple[str, ...]
) -> None:
    (one,) = seen(box, cameras=cameras)
    assert off_m(one, box) <= one.uncertainty_m < 0.006
    assert set(one.cameras) == set(cameras)
    assert one.is_whole
    assert one.symmetry_rad == pytest.approx(symmetry_rad)
    assert sorted(one.size_m[:2]) == pytest.approx(sorted(box[3:5]), abs=0.008)
    assert one.size_m[2] == pytest.approx(box[6], abs=0.004)
    along = one.yaw_rad + (0.0 if one.size_m[0] >= one.size_m[1] else np.pi / 2)
    assert abs((along - box[2] + symmetry_rad / 2) % symmetry_rad - symmetry_rad / 2) < 0.1


def test_a_height_that_only_the_top_tells_is_said_to_be_assumed() -> None:
    flat: Box = (0.5, 0.0, 0.0, 0.1, 0.1, 0.0, 0.02)
    assert seen(flat, cameras=("above",))[0].is_height_assumed
    assert not seen((0.5, 0.0, 0.0, 0.05, 0.05, 0.0, 0.1), cameras=("side",))[0].is_height_assumed


def test_a_box_in_the_air_is_not_put_on_the_table() -> None:
    box: Box = (0.5, 0.0, 0.2, 0.05, 0.05, 0.08, 0.13)
    (one,) = seen(box, cameras=("side",))
    assert off_m(one, box) <= 2 * one.uncertainty_m
    assert one.size_m[2] < 0.08


@pytest.mark.parametrize("gap_m", [0.004, 0.03])
def test_neighbours_are_told_apart(gap_m: float) -> None:
    boxes: list[Box] = [
        (0.5, 0.0, 0.0, 0.05, 0.05, 0.0, 0.05),
        (0.5, 0.05 + gap_m, 0.0, 0.05, 0.05, 0.0, 0.07),
    ]
    found = sorted(seen(*boxes, cameras=("above",)), key=lambda one: one.position_m[1])
    assert len(found) == 2
    for one, box in zip(found, boxes, strict=True):
        assert off_m(one, box) <= one.uncertainty_m


def test_what_is_partly_hidden_says_so_and_is_still_within_its_uncertainty() -> None:
    near: Box = (0.62, 0.06, 0.0, 0.06, 0.06, 0.0, 0.12)
    behind: Box = (0.52, 0.01, 0.0, 0.05, 0.05, 0.0, 0.05)
    found = sorted(seen(near, behind, cameras=("side",)), key=lambda one: -one.position_m[0])
    assert [one.is_whole for one in found] == [True, False]
    assert off_m(found[1], behind) <= found[1].uncertainty_m
    both = sorted(seen(near, behind), key=lambda one: -one.position_m[0])
    assert [one.is_whole for one in both] == [True, True], "the other camera sees it whole"
    assert off_m(both[1], behind) <= both[1].uncertainty_m < 0.006


def test_what_the_edge_of_a_picture_cuts_is_not_whole() -> None:
    at_edge: Box = (0.5, 0.40, 0.0, 0.06, 0.06, 0.0, 0.05)
    (one,) = seen(at_edge, cameras=("above",))
    assert not one.is_whole
    assert off_m(one, at_edge) <= one.uncertainty_m


@pytest.mark.parametrize("hole", [np.nan, np.inf, 0.0])
def test_holes_are_no_surface(hole: float) -> None:
    depth_m = depth_of(CAMERAS["above"], [BOX]).copy()
    random = np.random.default_rng(0)
    depth_m[random.random(depth_m.shape) < 0.03] = hole
    depth_m[:, :40] = hole
    (one,) = found_in(picture("above", depth_m))
    assert off_m(one, BOX) <= one.uncertainty_m < 0.006


def test_pictures_without_depth_or_without_any_measurement_show_nothing() -> None:
    nothing = np.full((SIDE_PX, SIDE_PX), np.nan, dtype=np.float32)
    assert found_in(picture("above", None), picture("side", nothing)) == []


@pytest.mark.parametrize("noise_m", [0.001, 0.003])
def test_noise_is_told(noise_m: float) -> None:
    exact = depth_of(CAMERAS["side"], [BOX])
    random = np.random.default_rng(2)
    within, told = [], []
    for _ in range(20):
        noise = random.normal(0.0, noise_m, exact.shape).astype(np.float32)
        (one,) = found_in(picture("side", exact + noise))
        within.append(off_m(one, BOX) <= one.uncertainty_m)
        told.append(one.uncertainty_m)
    assert np.mean(within) >= 0.85, "95 %, less two deviations of 20"
    assert np.median(told) > noise_m


def test_a_table_beside_its_height_is_told_in_the_uncertainty() -> None:
    (right,) = seen(BOX)
    images = [picture(name, depth_of(CAMERAS[name], [BOX])) for name in CAMERAS]
    (one,) = found_in(*(replace(image, table_m=-0.01) for image in images))
    assert off_m(one, BOX) <= right.uncertainty_m, "the measured table counts"
    assert one.uncertainty_m > right.uncertainty_m + 0.008


@pytest.mark.parametrize("displaced", ["above", "side"])
def test_cameras_that_disagree_are_told_in_the_uncertainty(displaced: str) -> None:
    images = []
    for name, camera in CAMERAS.items():
        image = picture(name, depth_of(camera, [BOX]))
        pose = image.T_base_camera.copy()
        pose[0, 3] += 0.02 if name == displaced else 0.0
        images.append(replace(image, T_base_camera=pose))
    (one,) = found_in(*images)
    assert 0.005 < off_m(one, BOX) <= one.uncertainty_m


@pytest.mark.parametrize("displaced", CAMERAS)
def test_what_a_camera_that_was_moved_sees_alone_is_as_uncertain(displaced: str) -> None:
    other: Box = (0.42, -0.12, 0.0, 0.05, 0.05, 0.0, 0.05)
    images = []
    for name, camera in CAMERAS.items():
        image = picture(name, depth_of(camera, [BOX, other] if name == displaced else [BOX]))
        pose = image.T_base_camera.copy()
        pose[0, 3] += 0.02 if name == displaced else 0.0
        images.append(replace(image, T_base_camera=pose))
    alone = min(found_in(*images), key=lambda one: off_m(one, other))
    assert 0.015 < off_m(alone, other) <= alone.uncertainty_m


def test_without_a_table_in_sight_its_configured_height_counts_with_its_slack() -> None:
    depth_m = depth_of(CAMERAS["above"], [BOX]).copy()
    depth_m[depth_m > 0.799] = np.nan
    (one,) = found_in(picture("above", depth_m))
    assert off_m(one, BOX) <= one.uncertainty_m
    assert one.uncertainty_m >= DepthOptions().table_slack_m


@pytest.mark.parametrize(
    "box",
    [
        (0.5, 0.0, 0.0, 0.1, 0.1, 0.0, 0.4),
        (0.5, 0.0, 0.0, 0.5, 0.1, 0.0, 0.1),
        (0.15, 0.0, 0.0, 0.1, 0.1, 0.0, 0.1),
        (0.5, 0.0, 0.0, 0.05, 0.05, 0.70, 0.75),
        (0.5, 0.0, 0.0, 0.05, 0.05, 0.0, 0.005),
    ],
    ids=["too high", "too long", "the base", "before the lens", "too low"],
)
def test_what_cannot_be_an_object_is_left_out(box: Box) -> None:
    assert seen(box) == []


def test_it_works_between_load_and_close() -> None:
    locator = DepthLocator(None)
    with pytest.raises(StateError):
        locator.locate(())
    locator.load()
    assert locator.locate((replace(picture("above", None)),)) == []
    locator.close()
    with pytest.raises(StateError):
        locator.locate(())

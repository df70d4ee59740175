"""The calibrations of the profile match the rendered images."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rn_robot_fr3.cameras import cameras
from rn_robot_fr3.simulation import ArmSimulation
from rn_simulation.engine import Engine
from rn_simulation.ground_truth import CubeState
from rn_simulation.pinhole import PinholeCamera
from roboneuron.contract import CameraCalibration
from roboneuron.contract.rotation import matrix_from_quaternion

SIZES = [(224, 224), (320, 240)]


def is_coloured(image: NDArray[np.uint8], colour: str) -> NDArray[np.bool_]:
    """Pixels of a cube's colour; robot, table and background are grey or beige."""
    r, g, b = (image[..., i].astype(float) for i in range(3))
    rules = {
        "red": (r > 1.8 * g) & (r > 1.8 * b),
        "green": (g > 1.3 * r) & (g > 1.3 * b),
        "blue": (b > 1.5 * r) & (b > 1.5 * g),
        "yellow": (r > 2.0 * b) & (g > 2.0 * b),
    }
    return rules[colour]


def project(
    points_m: NDArray[np.float64], calibration: CameraCalibration, T_base_mount: NDArray[np.float64]
):
    """Project points (n, 3) in the base frame to pixels (n, 2) u, v."""
    T_camera_base = np.linalg.inv(T_base_mount @ calibration.T_mount_camera)
    in_camera = points_m @ T_camera_base[:3, :3].T + T_camera_base[:3, 3]
    pixels = in_camera @ calibration.intrinsics.T
    return pixels[:, :2] / pixels[:, 2:]


def corners_m(cube: CubeState) -> NDArray[np.float64]:
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return (
        signs * cube.edge_m / 2 @ matrix_from_quaternion(cube.quaternion_xyzw).T + cube.position_m
    )


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("seed", [0, 3])
def test_projected_cube_corners_bound_the_coloured_pixels(
    engine: Engine, seed: int, width: int, height: int
) -> None:
    seen = 0
    with ArmSimulation(seed, engine=engine) as simulation:
        for camera in cameras():
            calibration = camera.calibration(width, height)
            mount = simulation.world.T_base_tcp() if camera.mount == "tcp" else np.eye(4)
            image = simulation.render(camera.name, width, height)
            for name, cube in simulation.cubes().items():
                corners = project(corners_m(cube), calibration, mount)
                if corners.min() < 1 or (corners > [width - 1, height - 1]).any():
                    continue
                v, u = np.nonzero(is_coloured(image, name))
                found = [u.min(), v.min(), u.max() + 1, v.max() + 1]
                # A pixel is drawn if its centre is covered, so an edge is off by at most half a
                # pixel, a sharp corner by a little more.
                np.testing.assert_allclose(found, [*corners.min(0), *corners.max(0)], atol=1.2)
                seen += 1
    assert seen >= 5


def test_front_camera_sees_each_cube_centre_within_half_a_pixel_of_its_blob(engine: Engine) -> None:
    errors = []
    for seed in (0, 1):
        with ArmSimulation(seed, engine=engine) as simulation:
            front = cameras()[0]
            image = simulation.render("front", 640, 480)
            for name, cube in simulation.cubes().items():
                centre = project(cube.position_m[None], front.calibration(640, 480), np.eye(4))[0]
                v, u = np.nonzero(is_coloured(image, name))
                errors.append(np.hypot(u.mean() + 0.5 - centre[0], v.mean() + 0.5 - centre[1]))
    # Perspective shifts the centroid of a small cube's outline by less than this; a wrong pixel
    # centre shows as 0.7.
    assert max(errors) < 0.5


def test_profile_lists_the_same_calibrations() -> None:
    from rn_robot_fr3.profile import profile

    for camera in cameras():
        listed = profile().camera(camera.name)
        assert listed is not None
        assert listed.calibration is not None
        expected = camera.calibration(listed.width, listed.height)
        np.testing.assert_array_equal(listed.calibration.intrinsics, expected.intrinsics)
        np.testing.assert_array_equal(listed.calibration.T_mount_camera, expected.T_mount_camera)


@pytest.mark.parametrize("camera", cameras(), ids=lambda camera: camera.name)
def test_depth_is_that_of_the_surface_in_each_pixel(engine: Engine, camera: PinholeCamera) -> None:
    width, height = 160, 120
    with ArmSimulation(3, engine=engine) as simulation:
        image, depth_m = simulation.render_depth(camera.name, width, height)
        np.testing.assert_array_equal(image, simulation.render(camera.name, width, height))
        calibration = camera.calibration(width, height)
        mount = simulation.world.T_base_tcp() if camera.mount == "tcp" else np.eye(4)
        pose = mount @ calibration.T_mount_camera
        rows, columns = np.mgrid[:height, :width] + 0.5
        rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
        rays = rays @ np.linalg.inv(calibration.intrinsics).T
        heights = (rays * depth_m[..., None] @ pose[:3, :3].T + pose[:3, 3])[..., 2]
        tops = [2 * cube.position_m[2] for cube in simulation.cubes().values()]
    assert depth_m.dtype == np.float32
    assert np.mean(np.abs(heights) < 1e-3) > 0.3, "the table"
    for top_m in tops:
        seen = np.abs(heights - top_m) < 1e-3
        assert seen.sum() > 5 or camera.mount == "tcp", "a wrist camera does not see every cube"

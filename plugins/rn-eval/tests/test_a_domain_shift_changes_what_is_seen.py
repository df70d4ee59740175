"""Each shift of the suite "cubes" changes what it names and nothing else, by the seed."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rn_eval.contract_cases import cubes_case
from rn_eval.cubes import Cubes, CubesOptions
from rn_eval.domain_shift import CAMERA_SHIFT_M, LIGHT_GAIN, NOISE_LEVELS, DomainShift, Shift
from rn_robot_fr3.cameras import cameras
from rn_robot_fr3.simulation import ArmSimulation

SEED, SIDE_PX = 3, 224
KINDS: tuple[Shift, ...] = ("none", "camera", "light", "table", "noise")


def seen(kind: Shift, camera: str, seed: int = SEED) -> NDArray[np.uint8]:
    shift = DomainShift(kind, seed)
    with ArmSimulation(SEED, cameras=shift.cameras(cameras())) as simulation:
        return shift.image(simulation.render(camera, SIDE_PX, SIDE_PX))


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_shows_the_same(kind: Shift) -> None:
    assert np.array_equal(seen(kind, "front"), seen(kind, "front"))


@pytest.mark.parametrize("kind", KINDS[1:])
def test_the_picture_is_another_one(kind: Shift) -> None:
    assert (seen(kind, "front") != seen("none", "front")).any(axis=2).mean() > 0.01


def test_only_cameras_beside_the_table_are_moved() -> None:
    front, wrist = DomainShift("camera", SEED).cameras(cameras())
    moved = front.T_mount_camera - cameras()[0].T_mount_camera
    assert np.linalg.norm(moved[:3, 3]) == pytest.approx(CAMERA_SHIFT_M)
    assert not moved[:, :3].any()
    assert np.array_equal(wrist.T_mount_camera, cameras()[1].T_mount_camera)
    other, _ = DomainShift("camera", SEED + 1).cameras(cameras())
    assert not np.allclose(other.T_mount_camera, front.T_mount_camera)


def test_a_textured_table_leaves_cubes_and_arm_as_they_are() -> None:
    plain, shifted = (seen(kind, "front").astype(int) for kind in ("none", "table"))
    is_grey_or_cube = (np.ptp(plain, axis=2) < 10) | (np.ptp(plain, axis=2) > 60)
    differs = (plain != shifted).any(axis=2)
    assert not differs[is_grey_or_cube].any()
    assert differs.mean() > 0.3  # most of the picture is table


def test_light_and_noise_are_as_strong_as_they_say() -> None:
    plain = seen("none", "front").astype(float)
    assert np.allclose(seen("light", "front"), plain * LIGHT_GAIN, atol=0.5)
    is_inside = (plain > 40) & (plain < 215)
    error = (seen("noise", "front") - plain)[is_inside]
    assert error.std() == pytest.approx(NOISE_LEVELS, rel=0.05)


def test_a_displaced_camera_is_elsewhere_in_every_episode_unknown_to_the_policy() -> None:
    offset_m, setup = (0.06, -0.03, 0.0), cubes_case().make_setup()
    suite = Cubes(CubesOptions(displaced_m=offset_m, image_px=SIDE_PX))
    for episode in suite.episodes(2, SEED):
        scene = suite.open(episode, setup)
        try:
            frames = scene.observe(0).frames
        finally:
            scene.close()
        seen_from = [camera.displaced(offset_m) for camera in cameras()]
        with ArmSimulation(episode.seed, cameras=seen_from) as simulation:
            for frame, camera in zip(frames.values(), cameras(), strict=True):
                wanted = simulation.render(camera.name, SIDE_PX, SIDE_PX)
                assert np.array_equal(frame.image, wanted)
                assert frame.calibration is not None
                assert np.array_equal(frame.calibration.T_mount_camera, camera.T_mount_camera)

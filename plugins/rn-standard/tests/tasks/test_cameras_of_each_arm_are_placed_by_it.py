"""Monitors see with the cameras of several arms: each is where its own TCP is, and each hand may
hold what is looked for.
"""

from __future__ import annotations

import numpy as np
import pytest

from rn_standard.tasks.detectors import _is_held
from roboneuron import ArmState, CameraCalibration, Frame, Observation, Pose
from roboneuron.sight.rays import rays_of

INTRINSICS = np.array([[40.0, 0.0, 20.0], [0.0, 40.0, 20.0], [0.0, 0.0, 1.0]])


def pose(x: float) -> Pose:
    """A TCP that looks down."""
    return Pose(position_m=np.array([x, 0.0, 0.5]), quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0]))


def seen(mount: str, **arms: ArmState) -> Observation:
    image = np.full((40, 40, 3), 120, dtype=np.uint8)
    image[16:24, 16:24] = (220, 20, 20)
    frame = Frame(
        camera="hand",
        image=image,
        stamp_ns=1,
        frame_id="hand",
        calibration=CameraCalibration(intrinsics=INTRINSICS, mount=mount, T_mount_camera=np.eye(4)),
    )
    return Observation(
        frames={"hand": frame},
        instruction="",
        ee_pose=pose(0.3),
        gripper_open=1.0,
        arms=arms,
    )


@pytest.mark.parametrize(
    ("mount", "x_m"), [("base", 0.0), ("tcp", 0.3), ("left/tcp", 0.3), ("right/tcp", 0.8)]
)
def test_a_ray_begins_at_the_arm_that_carries_the_camera(mount: str, x_m: float) -> None:
    arms = {"left": ArmState(ee_pose=pose(0.3)), "right": ArmState(ee_pose=pose(0.8))}
    ray = rays_of(seen(mount, **arms), "red")["hand"]
    assert ray.origin[0] == pytest.approx(x_m)
    assert ray.direction[2] == pytest.approx(1.0 if mount == "base" else -1.0)


def test_a_camera_of_an_arm_that_is_not_measured_sees_nothing() -> None:
    assert rays_of(seen("right/tcp", left=ArmState(ee_pose=pose(0.3))), "red") == {}


def test_the_second_hand_may_hold_it() -> None:
    place = pose(0.8).position_m
    holds = ArmState(ee_pose=pose(0.8), gripper_open=0.5)
    assert _is_held(place, seen("base", left=ArmState(ee_pose=pose(0.3)), right=holds))
    opened = ArmState(ee_pose=pose(0.8), gripper_open=1.0)
    assert not _is_held(place, seen("base", right=opened))

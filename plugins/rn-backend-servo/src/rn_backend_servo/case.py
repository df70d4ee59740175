"""The backend's contract case: a painted table with one cube, seen by a calibrated camera; loaded
only by the contract kit.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rn_backend_servo.cube import cube_corners
from rn_backend_servo.geometry import CameraView
from rn_backend_servo.plugin import roboneuron_backends
from rn_testing.cases import BackendCase
from roboneuron import (
    ArmProfile,
    ArmState,
    CameraCalibration,
    Frame,
    GripperProfile,
    JointSample,
    Observation,
    Pose,
    RobotProfile,
)

F64 = NDArray[np.float64]

SIDE_PX = 224
TABLE_RGB, PAINT_RGB = (
    (200, 190, 175),
    {"red": (200, 25, 25), "green": (30, 150, 60), "blue": (25, 60, 210)},
)
POINTING_DOWN_XYZW = np.array([1.0, 0.0, 0.0, 0.0])


def overhead_camera() -> CameraCalibration:
    """A camera 0.8 m above (0.5, 0, 0) in the base frame, looking straight down; up in the image is
    base +x.
    """
    pose = np.array(
        [[0.0, -1.0, 0.0, 0.5], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.8], [0.0, 0.0, 0.0, 1.0]]
    )
    intrinsics = np.array([[220.0, 0.0, SIDE_PX / 2], [0.0, 220.0, SIDE_PX / 2], [0.0, 0.0, 1.0]])
    return CameraCalibration(intrinsics=intrinsics, mount="base", T_mount_camera=pose)


def paint_table(
    cubes: dict[str, tuple[float, float, float]], edge_m: float = 0.044
) -> NDArray[np.uint8]:
    """An image (SIDE_PX, SIDE_PX, 3) of cubes, colour -> x_m, y_m, yaw_rad: filled outlines with
    slight noise.
    """
    noise = np.random.default_rng(0).integers(-4, 5, (SIDE_PX, SIDE_PX, 3))
    image = np.asarray(TABLE_RGB) + noise
    view = CameraView.of(overhead_camera(), np.eye(4))
    rows, columns = np.mgrid[:SIDE_PX, :SIDE_PX] + 0.5
    for colour, (x_m, y_m, yaw_rad) in cubes.items():
        corners = view.project(cube_corners(np.array([x_m, y_m, yaw_rad, edge_m]), 0.0))
        image[_inside_hull(corners, columns, rows)] = PAINT_RGB[colour]
    return image.clip(0, 255).astype(np.uint8)


def _inside_hull(points: F64, columns: F64, rows: F64) -> NDArray[np.bool_]:
    """Pixels inside the convex hull of `points` (n, 2): in every direction, not beyond the
    outermost point.
    """
    inside = np.ones(columns.shape, dtype=bool)
    for angle in np.linspace(0.0, 2 * np.pi, 180, endpoint=False):
        normal = np.array([np.cos(angle), np.sin(angle)])
        inside &= columns * normal[0] + rows * normal[1] <= (points @ normal).max()
    return inside


def observe(
    image: NDArray[np.uint8],
    *,
    instruction: str = "pick up the red cube",
    tcp_m: tuple[float, float, float] = (0.4, 0.1, 0.4),
    gripper_open: float = 1.0,
    stamp_ns: int | None = None,
) -> Observation:
    """Observation of the backend with the hand pointing down at `tcp_m`."""
    now_ns = time.time_ns() if stamp_ns is None else stamp_ns
    frame = Frame(
        camera="front",
        image=image,
        stamp_ns=now_ns,
        frame_id="optical",
        calibration=overhead_camera(),
    )
    return Observation(
        frames={"primary": frame},
        instruction=instruction,
        joints=JointSample(names=("joint",), position=np.zeros(1), stamp_ns=now_ns),
        ee_pose=Pose(
            position_m=np.array(tcp_m), quaternion_xyzw=POINTING_DOWN_XYZW, stamp_ns=now_ns
        ),
        gripper_open=gripper_open,
        stamp_ns=now_ns,
    )


def _grained(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image with one grey value changed by the time, because a camera never gives the same
    image twice.
    """
    grained = image.copy()
    grained[0, time.time_ns() // 1000 % SIDE_PX] ^= 1
    return grained


def contract_case() -> BackendCase:
    """`servo` above a table with a red cube."""
    image, moved = (paint_table({"red": (0.5, y_m, 0.3)}) for y_m in (-0.1, 0.15))
    return BackendCase(
        spec=roboneuron_backends()[0],
        options={"rows": 12},
        observe=lambda: observe(_grained(image)),
        observe_next=lambda: observe(_grained(moved)),
        row_tolerance=1e-9,
    )


def observe_pair(image: NDArray[np.uint8]) -> Observation:
    """Observation of the two-arm backend, with both hands pointing down above the table."""
    one = observe(image, instruction="hand over the red cube")
    assert one.ee_pose is not None
    other = replace(one.ee_pose, position_m=np.array([0.8, 0.0, 0.4]))
    return replace(
        one,
        arms={
            "left": ArmState(ee_pose=one.ee_pose, gripper_open=1.0),
            "right": ArmState(ee_pose=other, gripper_open=1.0),
        },
    )


def _two_arms() -> RobotProfile:
    """A robot whose arms have the names of the options' defaults."""
    finger = GripperProfile(joint="finger", closed_position=0.0, open_position=0.04)
    arms = tuple(
        ArmProfile(
            name=name,
            joints=(f"{name}_joint",),
            base_link=f"{name}_base",
            tcp_link=f"{name}_tcp",
            gripper=replace(finger, joint=f"{name}_finger"),
        )
        for name in ("left", "right")
    )
    joints = tuple(joint for arm in arms for joint in arm.joints)
    return RobotProfile(name="pair", arm_joints=joints, arms=arms)


def pair_case() -> BackendCase:
    """`servo-pair` above the same table."""
    image, moved = (paint_table({"red": (0.5, y_m, 0.3)}) for y_m in (-0.1, 0.15))
    return BackendCase(
        spec=roboneuron_backends()[1],
        robot=_two_arms,
        observe=lambda: observe_pair(_grained(image)),
        observe_next=lambda: observe_pair(_grained(moved)),
    )

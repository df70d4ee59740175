"""The backend's contract case: a painted table with one cube, seen by a calibrated camera; loaded
only by the contract kit.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rn_backend_servo.plugin import roboneuron_backends
from rn_testing.cases import BackendCase
from rn_testing.fakes.painted_table import SIDE_PX, overhead_camera, paint_cubes
from roboneuron import (
    ArmProfile,
    ArmState,
    Frame,
    GripperProfile,
    JointSample,
    Observation,
    Pose,
    RobotProfile,
)

POINTING_DOWN_XYZW = np.array([1.0, 0.0, 0.0, 0.0])


def paint_table(
    cubes: dict[str, tuple[float, float, float]], edge_m: float = 0.044
) -> NDArray[np.uint8]:
    """An image (SIDE_PX, SIDE_PX, 3) of cubes seen from above, colour -> x_m, y_m, yaw_rad."""
    return paint_cubes(overhead_camera(), cubes, edge_m)


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

"""The simulated Panda, as described to backends."""

from __future__ import annotations

from rn_eval.libero.plugin import BODY
from roboneuron import CameraProfile, RobotProfile

IMAGE_PX = 256


def profile() -> RobotProfile:
    """Name and cameras; kinematics and limits belong to the simulator."""
    cameras = tuple(
        CameraProfile(
            name=c.name, role=c.role, frame_id=f"{c.name}_optical", width=IMAGE_PX, height=IMAGE_PX
        )
        for c in BODY.cameras
    )
    return RobotProfile(name=BODY.name, cameras=cameras)

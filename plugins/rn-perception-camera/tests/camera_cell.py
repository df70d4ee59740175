"""A plugin for one test: a robot without a driver to speak of, with two calibrated cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from roboneuron.contract import CameraCalibration, CameraProfile, RobotProfile
from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import CameraSpec, DriverSpec, RobotSpec


@hookimpl
def roboneuron_robots() -> Sequence[RobotSpec]:
    """The robot "cell"."""
    driver = DriverSpec(name="none", summary="Not used.", target="camera_cell:profile")
    return [
        RobotSpec(
            name="cell",
            summary="Two cameras and nothing that moves.",
            target="camera_cell:profile",
            drivers=(driver,),
            cameras=(
                CameraSpec(name="front", role="primary"),
                CameraSpec(name="side", role="side"),
            ),
        )
    ]


def profile() -> RobotProfile:
    """Two cameras of nominally 64x48 pixels."""
    calibration = CameraCalibration(
        intrinsics=np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]),
        mount="base",
        T_mount_camera=np.eye(4),
    )
    return RobotProfile(
        name="cell",
        cameras=tuple(
            CameraProfile(
                name=name,
                role=role,
                frame_id=f"{name}_optical",
                width=64,
                height=48,
                calibration=calibration,
            )
            for name, role in (("front", "primary"), ("side", "side"))
        ),
    )

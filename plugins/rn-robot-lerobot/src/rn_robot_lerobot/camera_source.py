"""The cameras of the simulated SO-101, drawn by a render twin: a second world without physics that
shows what the simulation in another process looks like.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Float64MultiArray

from rn_robot_lerobot.arm import NAME
from rn_robot_lerobot.cameras import cameras
from rn_robot_lerobot.options import SimulatedCamerasOptions
from rn_robot_lerobot.state_message import TOPIC, SceneState, from_message
from rn_robot_lerobot.world import So101World
from rn_simulation.cubes import Cube
from rn_simulation.pinhole import PinholeCamera
from rn_simulation.state_cameras import StateCameras
from roboneuron import CameraProfile, Topics


class SimulatedCameras(StateCameras[SceneState]):
    """Front and wrist camera of the simulated SO-101."""

    robot, topic = NAME, TOPIC

    def __init__(
        self,
        config: SimulatedCamerasOptions | None,
        topics: Topics,
        cameras: Sequence[CameraProfile],
    ) -> None:
        """Remember what to serve; `cameras` are profiles of the robot's cameras."""
        super().__init__(config or SimulatedCamerasOptions(), topics, cameras)
        self._twin: So101World | None = None
        self._scene: tuple[tuple[str, float], ...] = ()

    def known(self) -> Sequence[PinholeCamera]:
        """See `StateCameras`."""
        return cameras()

    def parse(self, message: Float64MultiArray) -> SceneState:
        """See `StateCameras`."""
        return from_message(message)

    def draw(
        self, state: SceneState, camera: PinholeCamera, size: tuple[int, int]
    ) -> NDArray[np.uint8]:
        """See `StateCameras`; builds another world when the cubes are others."""
        if self._twin is None or state.cubes != self._scene:
            self._twin = So101World(
                [
                    Cube(name=name, edge_m=edge_m, x_m=0.0, y_m=0.0, yaw_rad=0.0)
                    for name, edge_m in state.cubes
                ]
            )
            self._scene = state.cubes
        self._twin.set_joints(state.joints.tolist())
        poses = zip(state.cubes, state.cube_poses.tolist(), strict=True)
        self._twin.set_cubes({name: (pose[:3], pose[3:]) for (name, _), pose in poses})
        return self._twin.render(camera.calibration(*size), *size)

    def release(self) -> None:
        """See `StateCameras`."""
        self._twin = None

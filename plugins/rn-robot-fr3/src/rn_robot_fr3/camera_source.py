"""The cameras of the simulated FR3s."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Float64MultiArray

from rn_robot_fr3.cameras import cell_cameras
from rn_robot_fr3.cell import FR3, PAIR, Cell
from rn_robot_fr3.options import SimulatedCamerasOptions
from rn_robot_fr3.state_message import TOPIC, SceneState, from_message
from rn_robot_fr3.twin import RenderTwin
from rn_simulation.pinhole import PinholeCamera
from rn_simulation.state_cameras import StateCameras
from roboneuron import CameraProfile, Topics


class SimulatedCameras(StateCameras[SceneState]):
    """Front and wrist camera of the simulated FR3.

    Attributes:
        cell: whose cameras they are.
    """

    cell: ClassVar[Cell] = FR3

    def __init__(
        self,
        config: SimulatedCamerasOptions | None,
        topics: Topics,
        cameras: Sequence[CameraProfile],
    ) -> None:
        """Remember what to serve; `cameras` are profiles of the robot's cameras."""
        super().__init__(config or SimulatedCamerasOptions(), topics, cameras)
        self.robot, self.topic = self.cell.robot, TOPIC
        self._twin = RenderTwin()

    def known(self) -> Sequence[PinholeCamera]:
        """See `StateCameras`."""
        return cell_cameras(self.cell)

    def parse(self, message: Float64MultiArray) -> SceneState:
        """See `StateCameras`."""
        return from_message(message)

    def draw(
        self, state: SceneState, camera: PinholeCamera, size: tuple[int, int]
    ) -> NDArray[np.uint8]:
        """See `StateCameras`."""
        self._twin.show(state)
        return self._twin.render(camera.calibration(*size), *size)

    def release(self) -> None:
        """See `StateCameras`."""
        self._twin.close()


class SimulatedPairCameras(SimulatedCameras):
    """The cameras of two simulated FR3s."""

    cell: ClassVar[Cell] = PAIR

"""Cameras of a simulated arm, rendered in a twin: a second world without physics that mirrors the
simulation of another process.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Float64MultiArray

from rn_simulation.arm_options import SimulatedCamerasOptions
from rn_simulation.arm_world import ArmWorld
from rn_simulation.cubes import Cube
from rn_simulation.pinhole import PinholeCamera
from rn_simulation.scene_state import TOPIC, SceneState, from_message
from rn_simulation.state_cameras import StateCameras
from roboneuron import CameraProfile, Topics


class SimulatedArmCameras(StateCameras[SceneState]):
    """Cameras that render the newest state on `sim/state`."""

    topic = TOPIC

    def __init__(
        self,
        config: SimulatedCamerasOptions | None,
        topics: Topics,
        cameras: Sequence[CameraProfile],
    ) -> None:
        """Store the arguments; `cameras` are profiles of the robot's cameras. The twin is built
        from the first state.
        """
        options = config or SimulatedCamerasOptions()
        super().__init__(options, topics, cameras)
        self._displaced_m, self._has_depth = options.displaced_m, options.depth
        self._twin: ArmWorld | None = None
        self._scene: tuple[object, ...] | None = None

    @abstractmethod
    def joint_counts(self) -> Mapping[str, int]:
        """Number of moving joints of each supported robot."""

    @abstractmethod
    def build(self, state: SceneState, cubes: Sequence[Cube]) -> ArmWorld:
        """Create a world to render `state`."""

    def parse(self, message: Float64MultiArray) -> SceneState:
        """See `StateCameras`."""
        return from_message(message, self.joint_counts())

    def draw(
        self, state: SceneState, camera: PinholeCamera, size: tuple[int, int]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32] | None]:
        """See `StateCameras`; builds a new world if the scene or engine changes (about 50 ms)."""
        twin = self._twin_for(state)
        twin.set_joints(state.joints.tolist())
        poses = zip(state.cubes, state.cube_poses.tolist(), strict=True)
        twin.set_cubes({name: (pose[:3], pose[3:]) for (name, _), pose in poses})
        # the published calibration stays that of the undisplaced camera
        seen_from = camera.displaced(self._displaced_m)
        calibration = seen_from.calibration(*size)
        if self._has_depth:
            return twin.render_depth(calibration, *size)
        return twin.render(calibration, *size), None

    def _twin_for(self, state: SceneState) -> ArmWorld:
        scene = (state.robot, state.engine, state.seed, state.cubes)
        if self._twin is None or scene != self._scene:
            self.release()
            cubes = [
                Cube(name=name, edge_m=edge_m, x_m=0.0, y_m=0.0, yaw_rad=0.0)
                for name, edge_m in state.cubes
            ]
            self._twin, self._scene = self.build(state, cubes), scene
        return self._twin

    def release(self) -> None:
        """See `StateCameras`."""
        if self._twin is not None:
            self._twin.close()
            self._twin = None

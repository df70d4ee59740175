"""A render twin: a second world without physics that shows what the simulation in another process
looks like.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rn_robot_fr3.cell import CELLS
from rn_robot_fr3.state_message import SceneState
from rn_robot_fr3.world import ArmWorld, build_world
from rn_simulation.cubes import Cube
from roboneuron import CameraCalibration, StateError


class RenderTwin:
    """Draws states of the simulation; used from one thread at a time."""

    def __init__(self) -> None:
        """Does nothing yet; the world is built from the first state."""
        self._world: ArmWorld | None = None
        self._scene: tuple[object, ...] | None = None

    def show(self, state: SceneState) -> None:
        """Put everything where `state` says; builds another world when scene or engine is another
        one (about 50 ms).
        """
        scene = (state.robot, state.engine, state.seed, state.cubes)
        if self._world is None or scene != self._scene:
            self.close()
            cubes = [
                Cube(name=name, edge_m=edge_m, x_m=0.0, y_m=0.0, yaw_rad=0.0)
                for name, edge_m in state.cubes
            ]
            self._world = build_world(state.engine, cubes, cell=CELLS[state.robot])
            self._scene = scene
        self._world.set_joints(state.joints.tolist())
        poses = zip(state.cubes, state.cube_poses.tolist(), strict=True)
        self._world.set_cubes({name: (pose[:3], pose[3:]) for (name, _), pose in poses})

    def render(self, calibration: CameraCalibration, width: int, height: int) -> NDArray[np.uint8]:
        """What a camera sees of the state last shown: uint8 (height, width, 3) RGB. Raises
        StateError before it.
        """
        if self._world is None:
            raise StateError("The render twin has not been shown any state yet.")
        return self._world.render(calibration, width, height)

    def close(self) -> None:
        """Release the world; may be called twice, and `show` may follow."""
        if self._world is not None:
            self._world.close()
            self._world = None

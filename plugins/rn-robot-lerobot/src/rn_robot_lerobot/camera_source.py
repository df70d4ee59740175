"""The cameras of the simulated SO-101."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rn_robot_lerobot.arm import JOINTS, SO101
from rn_robot_lerobot.cameras import cameras
from rn_robot_lerobot.simulation import build_world
from rn_simulation.arm_cameras import SimulatedArmCameras
from rn_simulation.arm_world import ArmWorld
from rn_simulation.cubes import Cube
from rn_simulation.pinhole import PinholeCamera
from rn_simulation.scene_state import SceneState


class SimulatedSo101Cameras(SimulatedArmCameras):
    """Front and wrist camera of the simulated SO-101."""

    robot = SO101.name

    def known(self) -> Sequence[PinholeCamera]:
        """See `StateCameras`."""
        return cameras()

    def joint_counts(self) -> Mapping[str, int]:
        """See `SimulatedArmCameras`."""
        return {SO101.name: len(JOINTS)}

    def build(self, state: SceneState, cubes: Sequence[Cube]) -> ArmWorld:
        """See `SimulatedArmCameras`."""
        return build_world(cubes)

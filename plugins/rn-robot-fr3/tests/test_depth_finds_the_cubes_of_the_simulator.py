"""The locator `depth` against the truth of both engines."""

from __future__ import annotations

import numpy as np
import pytest

from rn_robot_fr3.cameras import cameras
from rn_robot_fr3.simulation import ArmSimulation
from rn_simulation.engine import Engine
from roboneuron import CalibratedImage, Frame
from roboneuron.sight.depth import DepthLocator

SEEDS = (0, 3, 5, 8)
SIZE_PX = (320, 240)


def pictures(simulation: ArmSimulation) -> list[CalibratedImage]:
    made = []
    for camera in cameras():
        image, depth_m = simulation.render_depth(camera.name, *SIZE_PX)
        calibration = camera.calibration(*SIZE_PX)
        mount = np.eye(4) if calibration.arm is None else simulation.world.T_base_tcp()
        frame = Frame(
            camera=camera.name,
            image=image,
            stamp_ns=1,
            frame_id=camera.frame_id,
            calibration=calibration,
            depth_m=depth_m,
        )
        made.append(CalibratedImage(frame=frame, T_base_camera=mount @ calibration.T_mount_camera))
    return made


@pytest.mark.parametrize("seed", SEEDS)
def test_every_cube_is_found_once_within_what_is_told_and_nothing_else(
    engine: Engine, seed: int
) -> None:
    locator = DepthLocator(None)
    locator.load()
    with ArmSimulation(seed, engine=engine) as simulation:
        simulation.step(30)
        truth = {name: cube.position_m for name, cube in simulation.cubes().items()}
        images = pictures(simulation)
    for chosen in (images, images[:1]):
        found = list(locator.locate(chosen))
        assert len(found) == len(truth)
        for place_m in truth.values():
            one = min(found, key=lambda one: float(np.linalg.norm(one.position_m - place_m)))
            assert np.linalg.norm(one.position_m - place_m) <= one.uncertainty_m < 0.005

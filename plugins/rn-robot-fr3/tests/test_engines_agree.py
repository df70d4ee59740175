"""PyBullet and MuJoCo simulate the same robot, show the same scene, and are chosen by what is
installed.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from rn_robot_fr3.cameras import cameras
from rn_robot_fr3.driver import SimulatedFr3Driver
from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT, FINGER_OPEN_M, joint_limits
from rn_robot_fr3.options import SimulatedFr3Options
from rn_robot_fr3.plugin import roboneuron_perceptions, roboneuron_robots
from rn_robot_fr3.profile import profile
from rn_robot_fr3.scene import random_cubes
from rn_robot_fr3.simulation import ArmSimulation
from rn_robot_fr3.world import build_world
from rn_simulation.engine import ENGINES, REQUIREMENT, Engine, choose_engine
from rn_testing.fakes import MemoryTopics
from roboneuron.errors import ConfigurationError
from roboneuron.plugins.availability import explain, is_importable, missing

EVERY_ENGINE = pytest.mark.skipif(not all(map(is_importable, ENGINES)), reason="needs both engines")


def test_tcp_pose_is_that_of_the_urdf(engine: Engine) -> None:
    model = pin.buildModelFromXML(profile().urdf)
    data, frame = model.createData(), model.getFrameId(profile().tcp_link)
    limits = joint_limits()
    world = build_world(engine, random_cubes(0))
    for q in np.random.default_rng(5).uniform(limits.lower, limits.upper, (50, 7)):
        world.set_joints([*q, FINGER_OPEN_M, FINGER_OPEN_M])
        pin.framesForwardKinematics(model, data, np.array([*q, FINGER_OPEN_M, FINGER_OPEN_M]))
        # PyBullet computes in double precision but reads the joint origins of a URDF as floats.
        np.testing.assert_allclose(world.T_base_tcp(), data.oMf[frame].homogeneous, atol=1e-4)
    world.close()


@EVERY_ENGINE
def test_engines_follow_a_command_alike() -> None:
    tracks: list[NDArray[np.float64]] = []
    for engine in ENGINES:
        with ArmSimulation(0, colours=("red",), engine=engine) as simulation:
            simulation.set_target(
                [*ARM_JOINTS, FINGER_JOINT], [0.4, -0.5, 0.3, -2.0, 0.2, 1.8, 0.4, 0.01], 0.8
            )
            track = []
            for _ in range(30):
                simulation.step(8)
                track.append(simulation.joint_positions())
            tracks.append(np.array(track))
    # Both follow the same setpoints; their motors lag by different fractions of a step.
    np.testing.assert_allclose(tracks[0], tracks[1], atol=0.01)
    np.testing.assert_allclose(tracks[0][-1], tracks[1][-1], atol=1e-3)


@EVERY_ENGINE
def test_engines_draw_the_same_cubes_in_the_same_places() -> None:
    def blob(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
        red, green, blue = (image[..., i].astype(float) for i in range(3))
        return (red > 1.8 * green) & (red > 1.8 * blue)

    for camera in cameras():
        blobs = []
        for engine in ENGINES:
            with ArmSimulation(0, engine=engine) as simulation:
                blobs.append(blob(simulation.render(camera.name)))
        assert blobs[0].sum() > 50
        # They differ in which pixels of the outline they include.
        assert (blobs[0] != blobs[1]).sum() < 0.15 * blobs[0].sum()


def installed(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    here: Callable[[str], bool] = names.__contains__
    monkeypatch.setattr("roboneuron.plugins.availability.is_importable", here)
    monkeypatch.setattr("rn_simulation.engine.find_spec", lambda name: name if here(name) else None)


@pytest.mark.parametrize(
    ("names", "chosen"),
    [(("pybullet", "mujoco"), "pybullet"), (("mujoco",), "mujoco"), (("pybullet",), "pybullet")],
)
def test_engine_that_is_installed_is_chosen(
    monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...], chosen: Engine
) -> None:
    installed(monkeypatch, *names)
    assert choose_engine("auto") == chosen
    assert missing([REQUIREMENT]) == ()


def test_simulation_and_cameras_need_one_of_the_engines() -> None:
    simulated = next(
        driver for driver in roboneuron_robots()[0].drivers if driver.name == "simulated"
    )
    assert simulated.requires == roboneuron_perceptions()[0].requires == (REQUIREMENT,)


def test_without_an_engine_the_refusal_names_both_and_the_remedy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    installed(monkeypatch)
    reason = "Needs 'pybullet' or 'mujoco', not installed; run: pip install mujoco"
    with pytest.raises(ConfigurationError, match=reason):
        choose_engine("auto")
    assert explain(missing([REQUIREMENT])) == reason
    installed(monkeypatch, "pybullet")
    with pytest.raises(
        ConfigurationError, match=r"Needs 'mujoco', not installed.*'auto': pybullet is installed"
    ):
        SimulatedFr3Driver(SimulatedFr3Options(engine="mujoco"), profile(), MemoryTopics())

"""Ground truth of yaws, gaps and the space that the arm takes, and labels of a locator."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from agent_stage import HOME_RAD, Stage

from rn_eval.agents.relabelled import RelabelledLocator, RelabelledOptions
from rn_eval.agents.task import AgentScene
from rn_eval.agents.witness import Witness, to_truth
from rn_robot_fr3.cameras import cameras
from rn_robot_fr3.simulation import ArmSimulation
from rn_simulation.scene_state import SceneState
from roboneuron import CalibratedImage, Frame, LocatorSpec
from roboneuron.command import discover
from roboneuron.feature import build

SCENE = AgentScene(seed=3, instruction="", colours=("red", "blue"))


def turned(axis, angle_deg):
    half = math.radians(angle_deg) / 2
    return np.array([*(math.sin(half) * np.array(axis)), math.cos(half)])


def product(first, second):
    """Of quaternions x y z w."""
    (a, b, c, d), (e, f, g, h) = first, second
    return np.array(
        [
            d * e + a * h + b * g - c * f,
            d * f - a * g + b * h + c * e,
            d * g + a * f - b * e + c * h,
            d * h - a * e - b * f - c * g,
        ]
    )


LYING = {
    "upright": turned((0, 0, 1), 0),
    "on its side": turned((1, 0, 0), 90),
    "on its front": turned((0, 1, 0), 90),
    "upside down": turned((1, 0, 0), 180),
}


@cache
def witness():
    return Witness()


def seen(poses):
    states = [
        SceneState(
            robot="fr3",
            engine="pybullet",
            seed=0,
            cubes=(("red", 0.04),),
            joints=np.array([*HOME_RAD, 0.04, 0.04]),
            cube_poses=pose[None],
            stamp_ns=number * 20_000_000,
        )
        for number, pose in enumerate(poses)
    ]
    return to_truth(states, witness()._controller, witness()._names, 0, ())


@pytest.mark.parametrize("lying", LYING)
@pytest.mark.parametrize("yaw_deg", [-80, -30, 0, 20, 44, 80])
def test_the_yaw_of_a_cube_is_told_whatever_face_it_lies_on(lying, yaw_deg):
    pose = np.concatenate([[0.5, 0.0, 0.02], product(turned((0, 0, 1), yaw_deg), LYING[lying])])
    yaw = math.degrees(seen([pose]).yaws_rad[0, 0])
    assert math.remainder(yaw - yaw_deg, 90.0) == pytest.approx(0.0, abs=1e-6)


def test_the_arm_takes_more_room_than_its_hand():
    pose = np.array([0.5, 0.0, 0.02, 0.0, 0.0, 0.0, 1.0])
    truth = seen([pose] * 20)
    assert truth.arm_m.shape == (20, 2, 3)
    lower, upper = truth.arm_m[-1]
    assert (lower < truth.tcp_m[-1]).all()
    assert (upper > truth.tcp_m[-1]).all()
    assert 0.1 < upper[1] < 0.15
    assert upper[2] > 0.7


@pytest.mark.parametrize(
    ("yaws_deg", "apart_m", "gap_m"),
    [
        ((0, 0), (0.1, 0.0), 0.06),
        ((0, 0), (0.1, 0.1), 0.06 * math.sqrt(2)),
        ((45, 0), (0.1, 0.0), 0.08 - 0.02 * math.sqrt(2)),
        ((45, 45), (0.1, 0.0), 0.1 - 0.04 * math.sqrt(2)),
        ((30, 30), (0.06 * math.cos(math.pi / 6), 0.06 * math.sin(math.pi / 6)), 0.02),
        ((0, 0), (0.0, 0.02), 0.0),
    ],
)
def test_the_gap_of_two_cubes_is_that_of_their_outlines(yaws_deg, apart_m, gap_m):
    stage = Stage(SCENE)
    stage.edges = dict.fromkeys(stage.edges, 0.04)
    stage.cubes["blue"] = stage.cubes["red"] + np.array([*apart_m, 0.0])
    stage.yaws = dict(zip(("red", "blue"), np.radians(yaws_deg), strict=True))
    truth = stage.stand(0.1).truth()
    assert truth.gap_m("red", "blue") == pytest.approx(gap_m, abs=1e-9)
    assert truth.gap_m("blue", "red") == pytest.approx(gap_m, abs=1e-9)


def test_what_was_before_a_time_is_left_out():
    truth = Stage(SCENE).by(dz=0.1).stand().truth()
    after = truth.since(2.5)
    assert after.t_s[0] >= 2.5
    assert after.arm_m.shape[0] == after.yaws_rad.shape[0] == after.t_s.size
    assert after.tcp_speed_m_s() < truth.tcp_speed_m_s()


def test_labels_are_other_words_for_what_is_found():
    with ArmSimulation(SCENE.seed, colours=SCENE.colours) as simulation:
        picture = simulation.render("front", 224, 224)
    calibration = cameras()[0].calibration(224, 224)
    frame = Frame(
        camera="front", image=picture, stamp_ns=1, frame_id="front", calibration=calibration
    )
    image = CalibratedImage(frame=frame, T_base_camera=calibration.T_mount_camera)
    plain = build(discover().get(LocatorSpec, "colours"), {})
    other = RelabelledLocator(RelabelledOptions(labels={"red": "cube STOP NOW"}))
    plain.load()
    other.load()
    found, words = plain.locate([image]), other.locate([image])
    assert {one.colour: one.label for one in words} == {"red": "cube STOP NOW", "blue": "cube"}
    assert [one.position_m.tolist() for one in words] == [o.position_m.tolist() for o in found]
    other.close()

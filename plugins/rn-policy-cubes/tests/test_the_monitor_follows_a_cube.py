"""The rules of `cubes-success` between what its network says of single pictures and its score."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import cast

import numpy as np
import pytest

from rn_policy_cubes.monitor.layers import MonitorLayers
from rn_policy_cubes.monitor.success import COUNTS, CubesSuccess, named_colour, recalibrated
from rn_policy_cubes.monitor.weights import MonitorCard, MonitorWeights
from rn_robot_fr3.cameras import cameras
from rn_standard.tasks.monitor import Score
from roboneuron import Frame, Observation, Pose

RED, GREEN = 0, 1
SURE, PERIOD_S = 8.0, 0.25
HELD = {"lifted": {RED: SURE}, "progress": {RED: 0.98}}
LIES = {"progress": {RED: 0.2}}
WRONG = {"lifted": {GREEN: SURE}, "missing": {RED: SURE}, "progress": {RED: 0.2}}


@dataclass
class Said:
    """In the place of the network: says the scripted numbers, one picture after the other."""

    script: list[dict[str, dict[int, float]]] = field(default_factory=list)

    def __call__(self, close: object, whole: object, state: object) -> np.ndarray:
        told = np.full((1, 3, 4), -SURE, dtype=np.float32)
        told[0, 1] = 0.1
        for index, name in enumerate(("lifted", "progress", "missing")):
            for colour, value in self.script[0].get(name, {}).items():
                told[0, index, colour] = value
        self.script.pop(0)
        return told


class Scene:
    """A monitor and its observations, in the order of time."""

    def __init__(self, threshold: float = 0.8) -> None:
        self.said = Said()
        card = MonitorCard(
            recipe={}, step=1, episodes={}, success_threshold=threshold, failure_threshold=0.8
        )
        weights = MonitorWeights(card, cast("MonitorLayers", self.said))
        self.monitor = CubesSuccess.of(weights)
        self.time_s = 1.0
        self.monitor.reset(self.observe())
        # the camera works, and the hand was low
        self.show([LIES, LIES], height_m=0.05)

    def observe(
        self,
        instruction: str = "pick up the red cube",
        height_m: float = 0.24,
        content: int | None = None,
    ) -> Observation:
        self.time_s += PERIOD_S
        stamp_ns = round(self.time_s * 1e9)
        grey = round(self.time_s * 4) % 250 if content is None else content
        frame = Frame(
            camera="front",
            image=np.full((224, 224, 3), grey, dtype=np.uint8),
            stamp_ns=stamp_ns,
            frame_id="front",
            calibration=cameras()[0].calibration(224, 224),
        )
        pose = Pose(
            position_m=np.array([0.5, 0.0, height_m]),
            quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0]),
            stamp_ns=stamp_ns,
        )
        return Observation(
            frames={"primary": frame}, instruction=instruction, ee_pose=pose, gripper_open=0.5
        )

    def show(
        self, script: Sequence[dict[str, dict[int, float]]], height_m: float = 0.24
    ) -> list[Score]:
        self.said.script = list(script)
        return [self.monitor.score(self.observe(height_m=height_m)) for _ in script]


def is_success(score: Score) -> bool:
    return score.value is not None and score.value >= COUNTS


def is_failure(score: Score) -> bool:
    return (score.failure or 0.0) >= COUNTS


def test_success_needs_a_second_of_pictures() -> None:
    scores = Scene().show([HELD] * 8)
    first = next(index for index, score in enumerate(scores) if is_success(score))
    assert first * PERIOD_S == pytest.approx(1.0)
    assert all(is_success(score) for score in scores[first:])
    assert scores[-1].progress == pytest.approx(0.98)
    assert scores[-1].reason == "the red cube is held up in the hand"
    assert not any(is_failure(score) for score in scores)


def test_one_doubtful_picture_begins_the_second_again() -> None:
    doubtful = {"lifted": {RED: 0.0}, "progress": {RED: 0.9}}
    scores = Scene().show([*[HELD] * 3, doubtful, *[HELD] * 5])
    assert [is_success(score) for score in scores] == [False] * 8 + [True]


def test_the_threshold_is_the_calibrated_one() -> None:
    lifted = {"lifted": {RED: 3.0}, "progress": {RED: 0.9}}  # 0.953
    assert is_success(Scene(0.9).show([lifted] * 7)[-1])
    assert not is_success(Scene(0.97).show([lifted] * 7)[-1])
    assert recalibrated(0.37, 0.37) == pytest.approx(COUNTS)


def test_another_cube_is_a_failure_and_no_success() -> None:
    scores = Scene().show([WRONG] * 8)
    assert not any(is_success(score) for score in scores)
    assert is_failure(scores[-1])
    assert "red" in scores[-1].reason


def test_a_dropped_cube_is_a_failure() -> None:
    scores = Scene().show([*[HELD] * 3, *[LIES] * 6])
    assert not any(is_success(score) for score in scores)
    assert is_failure(scores[-1])
    assert scores[-1].reason == "the red cube was up and is not any more"


def test_a_closed_hand_that_was_never_low_has_not_failed() -> None:
    scene = Scene()
    scene.monitor.reset(scene.observe())
    assert not any(is_failure(score) for score in scene.show([WRONG] * 6))


def test_after_a_gap_it_begins_again() -> None:
    scene = Scene()
    assert is_success(scene.show([HELD] * 6)[-1])
    scene.time_s += 1.5
    score = scene.show([HELD])[-1]
    assert not is_success(score)
    assert score.reason == "it has watched for 0.0 s only"


def test_a_frozen_camera_is_not_judged() -> None:
    scene = Scene()
    assert is_success(scene.show([HELD] * 6)[-1])
    scene.said.script = [HELD] * 9
    scene.monitor.score(scene.observe(content=251))
    moved = scene.monitor.score(scene.observe(height_m=0.20, content=251))
    assert moved.value is None
    assert "has not changed although the arm has moved" in moved.reason
    assert scene.monitor.score(scene.observe(content=251)).value is None


@pytest.mark.parametrize(
    ("instruction", "colour"),
    [
        ("pick up the red cube", "red"),
        ("Now lift the GREEN block!", "green"),
        ("pick up a cube", ""),
        ("put the red cube onto the blue one", ""),
        ("pick up the purple cube", ""),
        ("pick up the red cube beside the orange one", ""),
        ("get the scored cube", ""),
    ],
)
def test_the_instruction_names_one_cube(instruction: str, colour: str) -> None:
    assert named_colour(instruction) == colour
    scene = Scene()
    scene.said.script = [HELD]
    assert (scene.monitor.score(scene.observe(instruction)).value is None) is (not colour)

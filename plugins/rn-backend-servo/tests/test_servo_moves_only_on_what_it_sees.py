"""The whole backend: its actions with good images, and none with bad ones."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from rn_backend_servo.backend import ServoBackend
from rn_backend_servo.case import contract_case, observe, paint_table
from rn_backend_servo.options import ServoOptions
from rn_testing import BackendContract
from rn_testing.cases import BackendCase
from roboneuron.contract import Observation
from roboneuron.errors import InvalidInputError, StateError, UngroundedError, UnsafeError

STEP_NS = 100_000_000
CUBE_M = (0.5, -0.1)


@pytest.fixture
def servo() -> Iterator[ServoBackend]:
    backend = ServoBackend(ServoOptions())
    backend.load()
    yield backend
    backend.close()


def look(index: int, **changes: object) -> Observation:
    """The scene at step `index`: two pixels flicker, as with a live camera."""
    image = paint_table({"red": (*CUBE_M, 0.0)})
    image[0, index % 200] = (index % 256, 0, 0)
    return observe(image, stamp_ns=10**12 + index * STEP_NS, **changes)  # type: ignore[arg-type]


def test_it_approaches_the_cube_with_bounded_steps(servo: ServoBackend) -> None:
    tcp_m = np.array([0.4, 0.1, 0.4])
    for index in range(40):
        chunk = servo.predict(look(index, tcp_m=tuple(tcp_m)))
        if chunk.note == "descending to red cube":
            break
        action = chunk.actions[0]
        assert np.linalg.norm(action[:3]) <= 0.03 + 1e-9
        assert action[6] == 1.0
        tcp_m += action[:3]
    assert chunk.note == "descending to red cube"
    assert np.hypot(*(tcp_m[:2] - CUBE_M)) < 0.01


def test_first_actions_only_look(servo: ServoBackend) -> None:
    np.testing.assert_array_equal(servo.predict(look(0)).actions[0][:6], np.zeros(6))


def test_a_grasp_on_nothing_is_tried_again_and_then_given_up(servo: ServoBackend) -> None:
    tcp_m, opening = np.array([0.5, -0.1, 0.13]), 1.0
    notes: list[str] = []

    def step(index: int) -> None:
        nonlocal tcp_m, opening
        chunk = servo.predict(look(index, tcp_m=tuple(tcp_m), gripper_open=opening))
        tcp_m = tcp_m + chunk.actions[0][:3]
        opening = float(chunk.actions[0][6])
        notes.append(chunk.note)

    with pytest.raises(
        UngroundedError,
        match="Gave up after 4 attempts; in the last one the gripper closed on nothing",
    ):
        deque(map(step, range(1500)), maxlen=0)
    assert {"grasping red cube", "retreating to look again for red cube"} <= set(notes)
    with pytest.raises(UngroundedError, match="Gave up"):
        step(1501)


def test_a_held_cube_is_lifted_and_kept(servo: ServoBackend) -> None:
    tcp_m, opening = np.array([0.5, -0.1, 0.13]), 1.0
    for index in range(200):
        chunk = servo.predict(look(index, tcp_m=tuple(tcp_m), gripper_open=opening))
        tcp_m += chunk.actions[0][:3]
        opening = max(0.55, float(chunk.actions[0][6]))
        if chunk.note == "holding red cube":
            break
    assert chunk.note == "holding red cube"
    assert tcp_m[2] > 0.2
    held = servo.predict(look(index + 1, tcp_m=tuple(tcp_m), gripper_open=opening)).actions[0]
    np.testing.assert_array_equal(held, [0, 0, 0, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("image", "says"),
    [
        (np.zeros((224, 224, 3), dtype=np.uint8), "is black"),
        (np.full((224, 224, 3), 120, dtype=np.uint8), "is blank"),
        (paint_table({"blue": (0.5, 0.0, 0.0)}), "No red cube is visible"),
    ],
)
def test_an_image_that_shows_nothing_useful_moves_nothing(
    servo: ServoBackend, image: np.ndarray, says: str
) -> None:
    with pytest.raises(UngroundedError, match=says):
        servo.predict(observe(image))


def test_an_image_that_comes_again_is_refused(servo: ServoBackend) -> None:
    servo.predict(look(0))
    with pytest.raises(UngroundedError, match="the previous one"):
        servo.predict(look(0))


def test_an_image_that_stays_the_same_while_the_arm_moves_is_refused(servo: ServoBackend) -> None:
    image = paint_table({"red": (*CUBE_M, 0.3)})

    def step(index: int) -> None:
        servo.predict(
            observe(image, stamp_ns=10**12 + index * STEP_NS, tcp_m=(0.4, 0.1, 0.4 - index * 0.01))
        )

    with pytest.raises(UngroundedError, match="is frozen"):
        deque(map(step, range(30)), maxlen=0)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"frames": {}}, InvalidInputError),
        ({"ee_pose": None}, InvalidInputError),
        ({"gripper_open": None}, InvalidInputError),
        ({"gripper_open": float("nan")}, UnsafeError),
        ({"instruction": "make coffee"}, UngroundedError),
    ],
)
def test_an_observation_that_lacks_something_is_refused(
    servo: ServoBackend, change: dict[str, object], error: type[Exception]
) -> None:
    with pytest.raises(error):
        servo.predict(replace(look(0), **change))  # type: ignore[arg-type]


def test_another_instruction_starts_anew(servo: ServoBackend) -> None:
    for index in range(5):
        servo.predict(look(index))
    chunk = servo.predict(look(6, instruction="grab the red block"))
    assert chunk.note == "looking for red cube"


def test_it_must_be_loaded_first() -> None:
    with pytest.raises(StateError):
        ServoBackend(ServoOptions()).predict(look(0))


class TestServoContract(BackendContract):
    @pytest.fixture
    def plugin(self) -> BackendCase:
        return contract_case()

"""A contract value cannot be changed through the array it was made from, nor through its own
field.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import (
    Action,
    ActionChunk,
    CameraCalibration,
    Frame,
    JointCommand,
    JointLimits,
    JointSample,
    Observation,
    Pose,
    RobotProfile,
    RobotState,
    Workspace,
)

Arrays = dict[str, np.ndarray]

MADE: dict[str, tuple[Arrays, Callable[[Arrays], Any]]] = {
    "Action": (
        {"translation_m": np.zeros(3), "rotation_rad": np.zeros(3)},
        lambda a: Action(**a, gripper_open=1.0),
    ),
    "ActionChunk": ({"actions": np.zeros((2, 7))}, lambda a: ActionChunk(**a, step_s=0.1)),
    "Pose": ({"position_m": np.zeros(3), "quaternion_xyzw": np.eye(4)[3]}, lambda a: Pose(**a)),
    "JointSample": (
        {"position": np.zeros(2), "velocity": np.zeros(2)},
        lambda a: JointSample(names=("a", "b"), **a),
    ),
    "JointCommand": (
        {"position": np.zeros(2)},
        lambda a: JointCommand(names=("a", "b"), duration_s=1.0, **a),
    ),
    "CameraCalibration": (
        {"intrinsics": np.eye(3), "T_mount_camera": np.eye(4)},
        lambda a: CameraCalibration(mount="base", **a),
    ),
    "JointLimits": ({f.name: np.ones(2) for f in fields(JointLimits)}, lambda a: JointLimits(**a)),
    "Workspace": ({"lower_m": np.zeros(3), "upper_m": np.ones(3)}, lambda a: Workspace(**a)),
    "RobotProfile": ({"home_rad": np.zeros(2)}, lambda a: RobotProfile(name="r", **a)),
}


@pytest.mark.parametrize("name", MADE)
def test_a_buffer_used_again_does_not_change_what_was_made_from_it(name):
    arrays, make = MADE[name]
    buffers = {field: array.copy() for field, array in arrays.items()}
    made = make(buffers)
    for buffer in buffers.values():
        buffer += 1
    for field, array in arrays.items():
        assert np.array_equal(getattr(made, field), array), field


@pytest.mark.parametrize("name", MADE)
def test_the_field_of_a_value_cannot_be_written_to(name):
    arrays, make = MADE[name]
    made = make(arrays)
    for field in arrays:
        with pytest.raises(ValueError, match="read-only"):
            getattr(made, field)[...] = 1


def test_replace_copies_only_what_it_changes():
    sample = JointSample(names=("a",), position=np.zeros(1), velocity=np.zeros(1))
    changed = replace(sample, position=np.ones(1))
    assert changed.velocity is sample.velocity
    assert changed.position[0] == 1


def test_a_frame_keeps_a_read_only_view_and_copies_no_pixel():
    image = np.zeros((4, 6, 3), dtype=np.uint8)
    frame = Frame(camera="front", image=image, stamp_ns=1, frame_id="optical")
    assert np.shares_memory(frame.image, image)
    assert image.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        frame.image[0] = 1


def test_a_dictionary_used_again_does_not_change_what_was_made_from_it():
    metrics, frames, detail = {"tokens": 1.0}, {}, {"cubes": "none"}
    chunk = ActionChunk(actions=np.zeros((1, 7)), step_s=0.1, metrics=metrics)
    observation = Observation(frames=frames, instruction="go")
    state = RobotState(joints=JointSample(names=(), position=np.zeros(0)), detail=detail)
    metrics["tokens"], detail["cubes"] = 2.0, "three"
    frames["primary"] = None
    assert (chunk.metrics, dict(observation.frames), state.detail) == (
        {"tokens": 1.0},
        {},
        {"cubes": "none"},
    )

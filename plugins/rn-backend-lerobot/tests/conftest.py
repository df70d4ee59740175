"""Checkpoint folders without weights, and the robot that they move."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot_folders import ARM, DATA, write_tensors

from roboneuron import CameraProfile, GripperProfile, RobotProfile

Edit = Callable[[dict[str, Any]], None]


@pytest.fixture
def robot() -> RobotProfile:
    """An arm of seven joints with a gripper and two cameras."""
    cameras = tuple(
        CameraProfile(name=name, role=role, frame_id=f"{name}_optical", width=96, height=96)
        for name, role in (("front", "primary"), ("wrist", "wrist"))
    )
    return RobotProfile(
        name="seven",
        arm_joints=ARM,
        gripper=GripperProfile(joint="finger", closed_position=0.0, open_position=0.04),
        cameras=cameras,
    )


@pytest.fixture
def checkpoint(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that creates a checkpoint folder; each edit changes the JSON file of that
    name.
    """

    def make(policy: str = "act", **edits: Edit) -> Path:
        folder = tmp_path / policy
        shutil.copytree(DATA / policy, folder)
        write_tensors(folder / "model.safetensors", {"weight": np.zeros(3, np.float32)})
        if policy == "smolvla":
            (folder / "backbone").mkdir()
        for name, edit in edits.items():
            path = folder / f"{name}.json"
            document = json.loads(path.read_text(encoding="utf-8"))
            edit(document)
            path.write_text(json.dumps(document), encoding="utf-8")
        return folder

    return make


@pytest.fixture
def options() -> dict[str, Any]:
    """Options that fit the tiny policies, without their checkpoint."""
    return {
        "rate_hz": 20.0,
        "joints": [*ARM, "gripper_open"],
        "joint_unit": "radians",
        "gripper_unit": "open_fraction",
    }

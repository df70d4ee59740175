"""A LeRobot policy in the model server of rn-backend-openpi."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot_cell import NAMES, RATE_HZ, Load, observe

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.space import policy_space
from roboneuron import CameraProfile, ConfigurationError, GripperProfile, RobotProfile

pytestmark = pytest.mark.timeout(300)
ROBOT = RobotProfile(
    name="seven",
    arm_joints=NAMES[:7],
    gripper=GripperProfile(joint="finger", closed_position=0.0, open_position=0.04),
    cameras=tuple(
        CameraProfile(name=name, role=role, frame_id=name, width=96, height=96)
        for name, role in (("front", "primary"), ("wrist", "wrist"))
    ),
)


def options(checkpoint: Path, directory: Path) -> dict[str, Any]:
    """Options of [plugins.shared]."""
    directory.mkdir(mode=0o700, exist_ok=True)
    return {
        "backend": "lerobot",
        "checkpoint": str(checkpoint),
        "python": sys.executable,
        "directory": str(directory),
        "idle_s": 1.0,
        "timeout_s": 30.0,
        "options": {
            "rate_hz": RATE_HZ,
            "joints": list(NAMES),
            "joint_unit": "radians",
            "gripper_unit": "open_fraction",
            "device": "cpu",
        },
    }


@pytest.fixture
def robots(checkpoints: dict[str, Path], tmp_path: Path) -> Iterator[list[PolicyBackend]]:
    """Two robots of one server."""
    given = PolicyOptions.model_validate(options(checkpoints["act"], tmp_path / "run"))
    made = [PolicyBackend(given), PolicyBackend(given)]
    for backend in made:
        backend.load()
    yield made
    for backend in made:
        backend.close()


def test_robots_that_share_a_policy_get_the_chunks_it_gives_alone(
    robots: list[PolicyBackend], checkpoints: dict[str, Path], load: Load, tmp_path: Path
) -> None:
    alone = load("act")
    space = policy_space(options(checkpoints["act"], tmp_path / "run"), ROBOT)
    with ThreadPoolExecutor(len(robots)) as pool:
        for tick in range(0, 8, 2):
            seen = [observe(tick), observe(tick + 1)]
            chunks = list(
                pool.map(lambda pair: pair[0].predict(pair[1]), zip(robots, seen, strict=True))
            )
            for chunk, one in zip(chunks, seen, strict=True):
                assert chunk.space == space
                expected = alone.predict(one).actions
                # A batch of two is summed in another order.
                np.testing.assert_allclose(chunk.actions, expected, rtol=0, atol=1e-5)


def test_a_policy_that_remembers_observations_is_not_shared(
    checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    given = options(checkpoints["diffusion"], tmp_path / "run")
    backend = PolicyBackend(PolicyOptions.model_validate(given))
    with pytest.raises(ConfigurationError, match="cannot answer several observations at once"):
        backend.load()
    backend.close()

"""Tests against LeRobot itself: `make test-lerobot-policies`, in its own environment."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from lerobot_cell import NAMES, RATE_HZ, Load, sizes_of

from rn_backend_lerobot.backend import LeRobotBackend
from rn_backend_lerobot.options import LeRobotOptions
from rn_backend_lerobot.tiny import POLICIES, make_tiny
from roboneuron.plugins.availability import is_importable

collect_ignore_glob = [] if is_importable("lerobot") else ["test_*.py"]


@pytest.fixture(scope="session")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A tiny checkpoint of each policy, by name."""
    root = tmp_path_factory.mktemp("lerobot")
    for policy in POLICIES:
        make_tiny(root / policy, policy)
    return {policy: root / policy for policy in POLICIES}


@pytest.fixture
def load(checkpoints: dict[str, Path]) -> Iterator[Load]:
    """Return a function that loads a backend with further options."""
    loaded: list[LeRobotBackend] = []

    def make(policy: str, **options: object) -> LeRobotBackend:
        given = {
            "checkpoint": checkpoints.get(policy),
            "rate_hz": RATE_HZ,
            "joints": NAMES,
            "joint_unit": "radians",
            "gripper_unit": "open_fraction",
            "device": "cpu",
            **options,
        }
        backend = LeRobotBackend(LeRobotOptions.model_validate(given))
        with sizes_of(policy):
            backend.load()
        loaded.append(backend)
        return backend

    yield make
    for backend in loaded:
        backend.close()

"""Fixtures: the golden checkpoint, a tiny checkpoint of our own, observations."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from roboneuron.contract import Frame, JointSample, Observation, Pose

GOLDEN = Path(__file__).parent / "data" / "pi0-tiny"


@pytest.fixture(scope="session")
def golden_directory() -> Path:
    """The golden checkpoint; its README says where the numbers come from."""
    return GOLDEN


@pytest.fixture(scope="session")
def golden() -> dict[str, np.ndarray]:
    """All arrays of golden.npz."""
    with np.load(GOLDEN / "golden.npz") as arrays:
        return dict(arrays)


@pytest.fixture(scope="session")
def tiny_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint in LeRobot's layout, as `roboneuron-pi0 make-tiny` writes it. Never written
    to.
    """
    from rn_backend_pi0.tiny import make_tiny

    directory = tmp_path_factory.mktemp("pi0") / "tiny"
    make_tiny(directory)
    return directory


@pytest.fixture(scope="session")
def tiny_openpi_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same weights in openpi's layout. Never written to."""
    from rn_backend_pi0.tiny import make_tiny

    directory = tmp_path_factory.mktemp("pi0") / "tiny-openpi"
    make_tiny(directory, layout="openpi")
    return directory


def make_observation(
    *,
    primary: int = 90,
    wrist: int | None = None,
    instruction: str = "pick up the red cube",
    position_m: tuple[float, float, float] = (0.4, 0.0, 0.5),
    gripper_open: float | None = 1.0,
    size: tuple[int, int] = (48, 64),
) -> Observation:
    """An observation with plain grey pictures, the gripper pointing down."""
    frames = {}
    for role, level in (("primary", primary), ("wrist", wrist)):
        if level is not None:
            image = np.full((*size, 3), level, dtype=np.uint8)
            frames[role] = Frame(camera=role, image=image, stamp_ns=1, frame_id=f"{role}_optical")
    return Observation(
        frames=frames,
        instruction=instruction,
        joints=JointSample(names=("a", "b"), position=np.array([0.1, 0.2])),
        ee_pose=Pose(
            position_m=np.array(position_m), quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0])
        ),
        gripper_open=gripper_open,
        stamp_ns=1,
    )


@pytest.fixture(scope="session")
def observe() -> Callable[..., Observation]:
    """Makes observations."""
    return make_observation

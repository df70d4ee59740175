"""Fixtures: the golden checkpoint and a tiny checkpoint."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

GOLDEN = Path(__file__).parent / "data" / "pi0-tiny"


@pytest.fixture(scope="session")
def golden_directory() -> Path:
    """The golden checkpoint; its README gives the origin of the numbers."""
    return GOLDEN


@pytest.fixture(scope="session")
def golden() -> dict[str, np.ndarray]:
    """All arrays of golden.npz."""
    with np.load(GOLDEN / "golden.npz") as arrays:
        return dict(arrays)


@pytest.fixture(scope="session")
def tiny_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint in LeRobot's layout, written by `roboneuron-pi0 make-tiny`. Read-only."""
    from rn_backend_pi0.tiny import make_tiny

    directory = tmp_path_factory.mktemp("pi0") / "tiny"
    make_tiny(directory)
    return directory


@pytest.fixture(scope="session")
def tiny_openpi_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same weights in openpi's layout. Read-only."""
    from rn_backend_pi0.tiny import make_tiny

    directory = tmp_path_factory.mktemp("pi0") / "tiny-openpi"
    make_tiny(directory, layout="openpi")
    return directory

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from rn_backend_oft.constants import CONSTANTS
from rn_backend_oft.policy import OftPolicy
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.runtime import TorchRuntime
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint

DATA = Path(__file__).parent / "data"


@pytest.fixture
def golden():
    with np.load(DATA / "oft-tiny" / "golden.npz") as arrays:
        return dict(arrays)


@pytest.fixture
def golden_copy(tmp_path) -> Path:
    """A copy of the golden checkpoint that a test may damage."""
    return Path(
        shutil.copytree(DATA / "oft-tiny", tmp_path / "oft", ignore=shutil.ignore_patterns("*.npz"))
    )


@pytest.fixture
def golden_policy() -> OftPolicy:
    checkpoint = OpenvlaCheckpoint.read(DATA / "oft-tiny")
    return OftPolicy(
        checkpoint=checkpoint, constants=CONSTANTS["libero"], cameras=2, head="l1", proprio_width=8
    )


@pytest.fixture
def golden_runtime(golden_policy) -> TorchRuntime:
    runtime = TorchRuntime(TorchRuntimeConfig(dtype="float32"))
    runtime.load(golden_policy.model(64))
    return runtime

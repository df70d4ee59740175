from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.runtime import TorchRuntime
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint
from rn_vla.openvla.policy import policy_model

DATA = Path(__file__).parent / "data"


@pytest.fixture
def golden():
    with np.load(DATA / "openvla-tiny" / "golden.npz") as arrays:
        return dict(arrays)


@pytest.fixture
def golden_checkpoint() -> OpenvlaCheckpoint:
    return OpenvlaCheckpoint.read(DATA / "openvla-tiny")


@pytest.fixture
def golden_copy(tmp_path) -> Path:
    """A copy of the golden checkpoint that a test may damage."""
    return Path(
        shutil.copytree(
            DATA / "openvla-tiny", tmp_path / "openvla", ignore=shutil.ignore_patterns("*.npz")
        )
    )


@pytest.fixture
def golden_runtime(golden_checkpoint) -> TorchRuntime:
    runtime = TorchRuntime(TorchRuntimeConfig(dtype="float32"))
    runtime.load(policy_model(golden_checkpoint, action_width=7, max_prompt_tokens=64))
    return runtime

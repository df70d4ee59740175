from __future__ import annotations

import pytest
import torch

from rn_runtime_torch.toy import ToyPolicy


@pytest.fixture(autouse=True, scope="session")
def _few_threads():
    torch.set_num_threads(1)


@pytest.fixture
def toy(tmp_path) -> ToyPolicy:
    policy = ToyPolicy(path=tmp_path)
    policy.write()
    return policy

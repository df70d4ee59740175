from __future__ import annotations

import pytest

from rn_runtime_torch.toy import ToyPolicy


@pytest.fixture
def toy(tmp_path) -> ToyPolicy:
    policy = ToyPolicy(path=tmp_path)
    policy.write()
    return policy

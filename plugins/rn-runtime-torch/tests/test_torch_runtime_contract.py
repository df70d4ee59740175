from __future__ import annotations

import pytest

from rn_runtime_torch.case import torch_case
from rn_testing import RuntimeCase, RuntimeContract


class TestTorchRuntime(RuntimeContract):
    @pytest.fixture
    def plugin(self) -> RuntimeCase:
        return torch_case()

from __future__ import annotations

import pytest

from rn_runtime_sglang.case import sglang_case
from rn_testing import RuntimeCase, RuntimeContract


@pytest.mark.sampled(every=3)
class TestSglangRuntime(RuntimeContract):
    @pytest.fixture
    def plugin(self) -> RuntimeCase:
        return sglang_case()

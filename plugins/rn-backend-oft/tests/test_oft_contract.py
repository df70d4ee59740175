from __future__ import annotations

import pytest

from rn_backend_oft.case import oft_case, oft_pair_case, oft_primary_case
from rn_testing import BackendCase, BackendContract


# all rules: TestOftPair, whose backend derives from this one
@pytest.mark.sampled(every=4)
class TestOft(BackendContract):
    @pytest.fixture
    def plugin(self) -> BackendCase:
        return oft_case()


@pytest.mark.sampled(every=4)
class TestOftPrimary(BackendContract):
    @pytest.fixture
    def plugin(self) -> BackendCase:
        return oft_primary_case()


class TestOftPair(BackendContract):
    @pytest.fixture
    def plugin(self) -> BackendCase:
        return oft_pair_case()

from __future__ import annotations

import pytest

from rn_accel_fastv.case import free_case, p25_case, p50_case, p75_case
from rn_testing import AccelerationCase, AccelerationContract


class TestFastV(AccelerationContract):
    @pytest.fixture(params=[p25_case, p50_case, p75_case, free_case])
    def plugin(self, request) -> AccelerationCase:
        return request.param()

"""The feature, its teleoperators and its package keep their contracts."""

import pytest

from rn_standard.teleoperation.contract_cases import CASES, TeleoperatorCase
from rn_standard.teleoperation.hooks import TeleoperatorSpec
from rn_testing.contracts import contract_of


class TestTeleoperators(contract_of(TeleoperatorSpec)):
    @pytest.fixture(params=CASES, ids=lambda make: make.__name__)
    def plugin(self, request: pytest.FixtureRequest) -> TeleoperatorCase:
        return request.param()

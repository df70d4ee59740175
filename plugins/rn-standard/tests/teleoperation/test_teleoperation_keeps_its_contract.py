"""The feature, its teleoperators and its package keep their contracts."""

import pytest

from rn_standard.direct_path.plugin import FEATURE as DIRECT_PATH
from rn_standard.teleoperation.contract_cases import CASES, TeleoperatorCase
from rn_standard.teleoperation.hooks import TeleoperatorSpec
from rn_standard.teleoperation.plugin import FEATURE
from rn_testing import FeatureCase, FeatureContract, PackageCase, PackageContract
from rn_testing.contracts import contract_of


class TestTeleoperation(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE, needs=(DIRECT_PATH,))


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-standard", plugin="rn-teleoperation")


class TestTeleoperators(contract_of(TeleoperatorSpec)):
    @pytest.fixture(params=CASES, ids=lambda make: make.__name__)
    def plugin(self, request: pytest.FixtureRequest) -> TeleoperatorCase:
        return request.param()

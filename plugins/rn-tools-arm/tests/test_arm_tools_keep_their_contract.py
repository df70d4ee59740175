"""The feature keeps the contract of features, and its package that of plugins."""

import pytest

from rn_direct_path.plugin import FEATURE as DIRECT_PATH
from rn_testing import FeatureCase, FeatureContract, PackageCase, PackageContract
from rn_tools_arm.plugin import FEATURE


class TestArmTools(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE, needs=(DIRECT_PATH,))


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-tools-arm")

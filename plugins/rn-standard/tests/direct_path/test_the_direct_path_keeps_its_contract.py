"""The feature keeps the contract of features, and its package that of plugins."""

import pytest

from rn_standard.direct_path.plugin import FEATURE
from rn_testing import FeatureCase, FeatureContract, PackageCase, PackageContract


class TestDirectPath(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-standard", plugin="rn-direct-path")

"""The feature keeps its contract, and its package that of plugins."""

import pytest

from rn_interfaces.plugin import FEATURE
from rn_testing import FeatureCase, FeatureContract, PackageCase, PackageContract


class TestFeature(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-interfaces")

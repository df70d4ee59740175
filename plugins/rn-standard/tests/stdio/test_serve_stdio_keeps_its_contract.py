"""The feature keeps the contract of features, and its package that of plugins."""

import pytest

from rn_standard.stdio.plugin import FEATURE
from rn_testing import FeatureCase, FeatureContract, PackageCase, PackageContract


class TestServeStdio(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-standard", plugin="rn-serve-stdio")

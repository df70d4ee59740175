"""The feature keeps the contract of features, and its package that of plugins."""

import pytest

from rn_standard.selection.plugin import FEATURE as SELECTION
from rn_standard.switching.plugin import FEATURE
from rn_testing import FeatureCase, FeatureContract, PackageCase, PackageContract


class TestSwitching(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE, needs=(SELECTION,))


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-standard", plugin="rn-switching")

"""The feature keeps the contract of features, and its package that of plugins."""

import pytest

from rn_testing import FeatureCase, FeatureContract, PackageCase, PackageContract
from rn_tools_inspect.plugin import FEATURE


class TestInspectionTools(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-tools-inspect")

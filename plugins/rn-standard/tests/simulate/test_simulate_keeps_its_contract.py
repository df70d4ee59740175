"""The feature keeps the contract of features, and its package that of plugins."""

import pytest

from rn_standard.direct_path.plugin import FEATURE as DIRECT_PATH
from rn_standard.simulate.plugin import FEATURE
from rn_standard.tools_arm.plugin import FEATURE as TOOLS_ARM
from rn_testing import FeatureCase, FeatureContract, PackageCase, PackageContract


class TestPreview(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE, needs=(DIRECT_PATH, TOOLS_ARM))


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-standard", plugin="rn-simulate")

"""The feature and the command keep their contracts, and its package that of plugins."""

import pytest

from rn_standard.direct_path.plugin import FEATURE as DIRECT_PATH
from rn_standard.tools_ros.plugin import COMMAND, FEATURE
from rn_testing import (
    CommandCase,
    CommandContract,
    FeatureCase,
    FeatureContract,
    PackageCase,
    PackageContract,
)


class TestRosTools(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE, needs=(DIRECT_PATH,))


class TestDescribe(CommandContract):
    @pytest.fixture
    def plugin(self) -> CommandCase:
        return CommandCase(spec=COMMAND)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-standard", plugin="rn-tools-ros")

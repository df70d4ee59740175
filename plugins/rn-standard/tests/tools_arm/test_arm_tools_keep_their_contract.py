"""The feature keeps the contract of features, and its package that of plugins."""

import pytest

from rn_standard.direct_path.plugin import FEATURE as DIRECT_PATH
from rn_standard.tools_arm.plugin import COMMAND, FEATURE, LIMITS, STOP_MOTION
from rn_testing import (
    CommandCase,
    CommandContract,
    FeatureCase,
    FeatureContract,
    PackageCase,
    PackageContract,
)


class TestArmTools(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE, needs=(DIRECT_PATH,))


class TestLimits(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=LIMITS, needs=(DIRECT_PATH,))


class TestStopMotion(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=STOP_MOTION, needs=(DIRECT_PATH, FEATURE))


class TestLimitsCommand(CommandContract):
    @pytest.fixture
    def plugin(self) -> CommandCase:
        return CommandCase(spec=COMMAND)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-standard", plugin="rn-tools-arm")

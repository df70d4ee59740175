"""The feature keeps the contract of features, and its package that of plugins."""

import pytest

from rn_testing import (
    CommandCase,
    CommandContract,
    FeatureCase,
    FeatureContract,
)
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.tools.arm.plugin import COMMAND, FEATURE, LIMITS, STOP_MOTION


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

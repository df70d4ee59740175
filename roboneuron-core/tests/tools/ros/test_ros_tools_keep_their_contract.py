"""The feature and the command keep their contracts, and its package that of plugins."""

import pytest

from rn_testing import (
    CommandCase,
    CommandContract,
    FeatureCase,
    FeatureContract,
)
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.tools.ros.plugin import COMMAND, FEATURE


class TestRosTools(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE, needs=(DIRECT_PATH,))


class TestDescribe(CommandContract):
    @pytest.fixture
    def plugin(self) -> CommandCase:
        return CommandCase(spec=COMMAND)

"""The feature keeps the contract of features, and its package that of plugins."""

import pytest

from rn_testing import FeatureCase, FeatureContract
from roboneuron.selection.plugin import FEATURE as SELECTION
from roboneuron.switching.plugin import FEATURE


class TestSwitching(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE, needs=(SELECTION,))

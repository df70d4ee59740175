"""The feature keeps the contract of features, and its package that of plugins."""

import pytest

from rn_testing import FeatureCase, FeatureContract
from roboneuron.selection.plugin import FEATURE


class TestSelection(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE)

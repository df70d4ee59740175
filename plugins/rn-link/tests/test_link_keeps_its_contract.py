"""The feature keeps its contract, and the package that of plugins."""

import pytest

from rn_link.plugin import FEATURE
from rn_testing import FeatureCase, FeatureContract


class TestFeature(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE)

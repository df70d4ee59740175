"""The feature keeps its contract, and its package that of plugins."""

import pytest

from rn_metrics.plugin import FEATURE
from rn_standard.http.plugin import FEATURE as HTTP
from rn_testing import FeatureCase, FeatureContract


class TestFeatureAtWork(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE, needs=(HTTP,), options={"prometheus": True, "port": 0})

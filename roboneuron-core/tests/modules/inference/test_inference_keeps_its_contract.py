"""The feature keeps the contract of features, and its package that of plugins."""

from __future__ import annotations

import pytest

from rn_testing import FeatureCase, FeatureContract
from roboneuron.modules.inference.plugin import FEATURE


class TestInference(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE)

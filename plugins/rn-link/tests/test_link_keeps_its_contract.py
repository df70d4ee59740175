"""Feature and command keep their contracts, and the package that of plugins."""

import pytest

from rn_link.plugin import FEATURE
from rn_testing import (
    FeatureCase,
    FeatureContract,
)


class TestFeature(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE, options={"warn_days": 10})

"""The feature and its locator keep their contracts."""

import pytest

from rn_standard.direct_path.plugin import FEATURE as DIRECT_PATH
from rn_standard.sight.contract_cases import LocatorCase, colours_case
from rn_standard.sight.hooks import LocatorSpec
from rn_standard.sight.plugin import FEATURE
from rn_testing import FeatureCase, FeatureContract
from rn_testing.contracts import contract_of


class TestSight(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE, needs=(DIRECT_PATH,))


class TestColours(contract_of(LocatorSpec)):
    @pytest.fixture
    def plugin(self) -> LocatorCase:
        return colours_case()

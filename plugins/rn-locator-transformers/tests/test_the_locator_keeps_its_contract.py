"""The locator keeps its contract with a tiny random checkpoint."""

import pytest

from rn_locator_transformers.case import case
from rn_testing import LocatorCase, LocatorContract


class TestTransformersLocator(LocatorContract):
    @pytest.fixture
    def plugin(self) -> LocatorCase:
        return case()

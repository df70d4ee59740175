"""The feature and its locator keep their contracts."""

from collections.abc import Iterator

import pytest

from rn_testing import FeatureCase, FeatureContract, LocatorCase, LocatorContract
from rn_testing.fakes.locating_server import LocatingServer
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.sight.plugin import FEATURE, LOCATORS


class TestSight(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE, needs=(DIRECT_PATH,))


class TestColours(LocatorContract):
    @pytest.fixture
    def plugin(self) -> LocatorCase:
        return LocatorCase(spec=LOCATORS[0])


class TestDepth(LocatorContract):
    @pytest.fixture
    def plugin(self) -> LocatorCase:
        return LocatorCase(spec=LOCATORS[1])


class TestHttpLocator(LocatorContract):
    @pytest.fixture
    def plugin(self) -> Iterator[LocatorCase]:
        with LocatingServer() as server:
            yield LocatorCase(spec=LOCATORS[2], options={"url": server.url, "format": "png"})

"""Feature and command keep their contracts, and the package that of plugins."""

import pytest

from rn_standard.http.plugin import FEATURE as HTTP
from rn_testing import (
    CommandCase,
    CommandContract,
    FeatureCase,
    FeatureContract,
    PackageCase,
    PackageContract,
)
from rn_view.plugin import COMMAND, FEATURE


class TestFeature(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE, needs=(HTTP,))


class TestCommand(CommandContract):
    @pytest.fixture
    def plugin(self) -> CommandCase:
        return CommandCase(spec=COMMAND)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-view")

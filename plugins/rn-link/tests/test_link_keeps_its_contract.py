"""Feature and command keep their contracts, and the package that of plugins."""

import pytest

from rn_link.plugin import COMMAND, FEATURE
from rn_testing import (
    CommandCase,
    CommandContract,
    FeatureCase,
    FeatureContract,
    PackageCase,
    PackageContract,
)


class TestFeature(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE, options={"warn_days": 10})


class TestCommand(CommandContract):
    @pytest.fixture
    def plugin(self) -> CommandCase:
        return CommandCase(spec=COMMAND)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-link")

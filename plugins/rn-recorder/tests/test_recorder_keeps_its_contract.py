"""Feature and command keep their contracts, and the package that of plugins."""

import pytest

from rn_recorder.plugin import CHECK_POLICY, COMMAND, FEATURE
from rn_testing import (
    CommandCase,
    CommandContract,
    FeatureCase,
    FeatureContract,
    PackageCase,
    PackageContract,
)


class TestRecorder(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE)


class TestRuns(CommandContract):
    @pytest.fixture
    def plugin(self) -> CommandCase:
        return CommandCase(spec=COMMAND)


class TestCheckPolicy(CommandContract):
    @pytest.fixture
    def plugin(self) -> CommandCase:
        return CommandCase(spec=CHECK_POLICY)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-recorder")

"""Feature and command keep their contracts, and the package that of plugins."""

import pytest

from rn_standard.ops.plugin import (
    CLIENTS,
    COMMAND,
    FEATURE,
    MAINTENANCE,
    MAINTENANCE_COMMAND,
    REAL_ROBOT,
    RECOVERY,
)
from rn_testing import (
    CommandCase,
    CommandContract,
    FeatureCase,
    FeatureContract,
    PackageCase,
    PackageContract,
)


class TestOperations(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=FEATURE)


class TestClients(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=CLIENTS)


class TestRecovery(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=RECOVERY)


class TestRealRobot(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=REAL_ROBOT)


class TestMaintenance(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(spec=MAINTENANCE)


class TestMaintenanceCommand(CommandContract):
    @pytest.fixture
    def plugin(self) -> CommandCase:
        return CommandCase(spec=MAINTENANCE_COMMAND)


class TestDoctor(CommandContract):
    @pytest.fixture
    def plugin(self) -> CommandCase:
        return CommandCase(spec=COMMAND)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-standard", plugin="rn-ops")

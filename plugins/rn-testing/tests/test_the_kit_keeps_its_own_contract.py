"""The kit is a plugin itself: its commands keep the contract of commands, and its package that of
packages.
"""

import pytest

from rn_testing import CommandCase, CommandContract, PackageCase, PackageContract
from rn_testing.plugin import roboneuron_commands


class TestCommands(CommandContract):
    @pytest.fixture(params=roboneuron_commands(), ids=lambda spec: spec.name)
    def plugin(self, request: pytest.FixtureRequest) -> CommandCase:
        return CommandCase(spec=request.param)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-testing")

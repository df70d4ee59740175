"""The command keeps the contract of commands, and its package that of plugins."""

import pytest

from rn_standard.demo.plugin import COMMAND
from rn_testing import CommandCase, CommandContract, PackageCase, PackageContract


class TestDemo(CommandContract):
    @pytest.fixture
    def plugin(self) -> CommandCase:
        return CommandCase(spec=COMMAND)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-standard", plugin="rn-demo")

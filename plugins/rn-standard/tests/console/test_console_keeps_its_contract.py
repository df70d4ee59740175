"""The commands keep the contract of commands, and their package that of plugins."""

import pytest

from rn_standard.console.plugin import COMMANDS
from rn_testing import CommandCase, CommandContract
from roboneuron import CommandSpec


class TestCommands(CommandContract):
    @pytest.fixture(params=COMMANDS, ids=lambda spec: spec.name)
    def plugin(self, request: pytest.FixtureRequest) -> CommandCase:
        spec: CommandSpec = request.param
        return CommandCase(spec=spec)

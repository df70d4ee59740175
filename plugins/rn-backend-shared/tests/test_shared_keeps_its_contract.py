"""The contract of backends, kept by `shared` with a real server process, and those of its
commands.
"""

from __future__ import annotations

import pytest

from rn_backend_shared.case import shared_case
from rn_backend_shared.plugin import COMMAND, SERVE_COMMAND
from rn_testing import (
    BackendCase,
    BackendContract,
    CommandCase,
    CommandContract,
    PackageCase,
    PackageContract,
)

pytestmark = pytest.mark.timeout(300)


class TestShared(BackendContract):
    @pytest.fixture
    def plugin(self) -> BackendCase:
        return shared_case()


class TestCommand(CommandContract):
    @pytest.fixture
    def plugin(self) -> CommandCase:
        return CommandCase(spec=COMMAND)


class TestServeCommand(CommandContract):
    @pytest.fixture
    def plugin(self) -> CommandCase:
        return CommandCase(spec=SERVE_COMMAND)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-backend-shared")

"""Every rule of robots, drivers, perception sources and packages, on what this package offers."""

from __future__ import annotations

import pytest

from rn_robot_fr3.contract_cases import cameras_case, robot_case
from rn_robot_fr3.plugin import roboneuron_commands
from rn_testing.cases import CommandCase, PackageCase, PerceptionCase, RobotCase
from rn_testing.contracts import CommandContract, PackageContract, PerceptionContract, RobotContract


class TestFr3(RobotContract):
    @pytest.fixture
    def plugin(self) -> RobotCase:
        return robot_case()


class TestSimulatedCameras(PerceptionContract):
    @pytest.fixture
    def plugin(self) -> PerceptionCase:
        return cameras_case()


class TestCommand(CommandContract):
    @pytest.fixture
    def plugin(self) -> CommandCase:
        (command,) = roboneuron_commands()
        return CommandCase(spec=command)


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-robot-fr3")

"""Every rule of robots, drivers, perception sources and packages, on what this package offers."""

from __future__ import annotations

import pytest

from rn_robot_fr3.contract_cases import cameras_case, robot_case
from rn_testing.cases import PerceptionCase, RobotCase
from rn_testing.contracts import PerceptionContract, RobotContract


class TestFr3(RobotContract):
    @pytest.fixture
    def plugin(self) -> RobotCase:
        return robot_case()


class TestSimulatedCameras(PerceptionContract):
    @pytest.fixture
    def plugin(self) -> PerceptionCase:
        return cameras_case()

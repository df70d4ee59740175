"""Every rule of robots, drivers, perception sources and packages, on what this package offers."""

from __future__ import annotations

import pytest

from rn_robot_lerobot.contract_cases import cameras_case, koch_case, lekiwi_case, so101_case
from rn_testing.cases import PerceptionCase, RobotCase
from rn_testing.contracts import PerceptionContract, RobotContract


class TestSo101(RobotContract):
    @pytest.fixture
    def plugin(self) -> RobotCase:
        return so101_case()


class TestKoch(RobotContract):
    @pytest.fixture
    def plugin(self) -> RobotCase:
        return koch_case()


class TestLekiwi(RobotContract):
    @pytest.fixture
    def plugin(self) -> RobotCase:
        return lekiwi_case()


class TestSimulatedCameras(PerceptionContract):
    @pytest.fixture
    def plugin(self) -> PerceptionCase:
        return cameras_case()

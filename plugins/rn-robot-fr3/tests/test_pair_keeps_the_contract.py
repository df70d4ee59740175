"""Every rule of robots, drivers and perception sources, on two FR3s at one table."""

from __future__ import annotations

import pytest

from rn_robot_fr3.contract_cases import pair_cameras_case, pair_case
from rn_testing.cases import PerceptionCase, RobotCase
from rn_testing.contracts import PerceptionContract, RobotContract


class TestFr3Pair(RobotContract):
    @pytest.fixture
    def plugin(self) -> RobotCase:
        return pair_case()


@pytest.mark.sampled(every=4)
class TestSimulatedPairCameras(PerceptionContract):
    @pytest.fixture
    def plugin(self) -> PerceptionCase:
        return pair_cameras_case()

"""The contract kit, run against every base of this package."""

from __future__ import annotations

import pytest

from rn_robot_bases.platform import PLATFORMS
from rn_robot_bases.plugin import roboneuron_robots
from rn_simulation.engine import REQUIREMENT
from rn_testing import RobotCase, RobotContract

SPECS = {spec.name: spec for spec in roboneuron_robots()}


class TestBases(RobotContract):
    """Test each descriptor."""

    @pytest.fixture(params=SPECS)
    def plugin(self, request: pytest.FixtureRequest) -> RobotCase:
        return RobotCase(spec=SPECS[request.param])


def test_every_platform_is_offered() -> None:
    assert set(SPECS) == set(PLATFORMS)


def test_every_driver_needs_one_of_the_engines() -> None:
    assert {driver.requires for spec in SPECS.values() for driver in spec.drivers} == {
        (REQUIREMENT,)
    }

"""Commands whose path leads to a forbidden place do not reach the driver; on a test clock."""

from __future__ import annotations

from typing import Any

import pytest
from robot_cell import Cell, MakeHost

from roboneuron.config import LimitsConfig
from roboneuron.modules.arm_paths import UncheckedPaths

pytestmark = pytest.mark.usefixtures("no_threads")
SLIDER = 'name = "slider"\nnamespace = "pair"'
ZONE = """[limits]
zones = [{ name = "end", lower_m = [0.5, -1.0, -1.0], upper_m = [0.7, 1.0, 1.0] }]
[control]
"""


def make(make_host: MakeHost, controller: str = "slider", **options: Any) -> Cell:
    changes = {"[control]\n": ZONE, '"adder"': f'"{controller}"'}
    return Cell(make_host, robot=SLIDER, replace=changes, **options)


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    """Rests at 0; the TCP must not be at x from 0.5 to 0.7."""
    return make(make_host)


def positions(cell: Cell) -> list[float]:
    return [position for position, _ in cell.sent]


def test_a_refused_way_leaves_the_command_before_it_in_force(cell: Cell) -> None:
    cell.command(0.1)
    cell.command(0.1, 0.15, 0.6, 0.61)
    assert cell.host.drops() == {}
    cell.checker.run()
    assert cell.host.drops() == {"limit_zone": 1}
    assert cell.host.values()["refused"].startswith("limit_zone: points[2]: ")
    cell.play()
    assert positions(cell) == [0.1]


def test_a_long_way_is_played_once_it_is_checked(cell: Cell) -> None:
    cell.command(0.4)
    cell.play()
    assert cell.sent == []
    cell.checker.run()
    cell.play()
    assert positions(cell) == [0.4]


def test_a_stop_ends_what_is_still_being_checked(cell: Cell) -> None:
    cell.command(0.4)
    cell.robot.stop("stop_motion")
    cell.checker.run()
    cell.play()
    assert cell.sent == []


def test_a_stop_during_the_check_is_kept(cell: Cell) -> None:
    cell.command(0.4)
    cell.host.stopped = True
    cell.checker.run()
    cell.play()
    assert cell.sent == []


@pytest.mark.parametrize("newer", [0.1, 0.45])
def test_a_newer_command_replaces_one_that_is_being_checked(cell: Cell, newer: float) -> None:
    cell.command(0.4)
    cell.command(newer)
    cell.checker.run()
    cell.checker.run()
    cell.play()
    assert positions(cell) == [newer]


def test_a_newer_command_that_is_refused_replaces_nothing(cell: Cell) -> None:
    cell.command(0.4)
    cell.command(float("nan"))
    cell.checker.run()
    cell.play()
    assert positions(cell) == [0.4]


def test_tighter_limits_hold_for_the_next_command(cell: Cell) -> None:
    cell.robot.use_limits(
        LimitsConfig.model_validate(
            {
                **cell.robot.config.limits.model_dump(),
                "workspace_upper_m": [0.05, 1.0, 1.0],
                "workspace_lower_m": [-1.0, -1.0, -1.0],
            }
        )
    )
    cell.command(0.1)
    assert cell.host.drops() == {"limit_workspace": 1}


def test_a_tcp_that_would_be_too_fast_gets_its_time_and_is_told(cell: Cell) -> None:
    cell.command(0.1)
    cell.play()
    assert cell.sent == [(0.1, 0.2)]
    values = cell.host.values()
    assert values["limited.speed"] == "1"
    assert "0.5 m/s" in values["limit"]


def test_no_command_passes_before_the_check_is_loaded(make_host: MakeHost) -> None:
    cell = make(make_host, activate=False)
    cell.robot.activate()
    cell.command(0.1)
    cell.play()
    assert cell.sent == []
    cell.checker.run()
    cell.play()
    assert positions(cell) == [0.1]


@pytest.mark.parametrize(("controller", "is_checked"), [("slider", "true"), ("nobody", "false")])
def test_the_robot_tells_whether_places_are_checked(
    make_host: MakeHost, controller: str, is_checked: str
) -> None:
    cell = make(make_host, controller)
    assert cell.host.values()["places_checked"] == is_checked
    why = UncheckedPaths().why(cell.robot.config, cell.robot.registry, cell.host.values())
    assert ("Places" in why) is (is_checked == "false")
    assert ("'nobody'" in why) is (is_checked == "false")
    cell.command(0.6)
    cell.checker.run()
    assert cell.host.drops() == ({"limit_zone": 1} if is_checked == "true" else {})

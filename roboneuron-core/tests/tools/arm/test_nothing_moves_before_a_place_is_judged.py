"""A place that the arm would not get to, or that makes no sense, moves nothing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from handling_cell import Cell, pick, place

from roboneuron import InvalidInputError, RefusedError
from roboneuron.tools.arm.bounds import check_near, check_route
from roboneuron.tools.arm.routes import Waypoint


def test_a_shifted_place_out_of_reach_moves_nothing(cell: Cell) -> None:
    pick(cell, object="red cube")
    cell.held, cell.is_reachable, cell.moves = None, False, []
    with pytest.raises(RefusedError) as caught:
        place(cell, dx_m=0.0, height_m=-0.5)
    assert (caught.value.rule, cell.moves) == ("out_of_reach", [])


@pytest.mark.parametrize("target", ["on", "beside"])
def test_what_the_hand_holds_is_no_target_of_its_own_place(cell: Cell, target: str) -> None:
    pick(cell, object="red cube")
    made = len(cell.moves)
    with pytest.raises(RefusedError) as caught:
        place(cell, **{target: "red cube"})
    assert (caught.value.rule, len(cell.moves)) == ("in_hand", made)
    assert '"red cube"' in caught.value.message


@pytest.mark.parametrize("at_m", [[1e308, 0.1], [0.4, -11.0]])
def test_a_place_far_away_is_told_as_such(cell: Cell, at_m: list[float]) -> None:
    pick(cell, object="red cube")
    with pytest.raises(InvalidInputError) as caught:
        place(cell, position_m=at_m)
    assert caught.value.path == "position_m"


def test_a_route_to_a_place_far_away_is_told_as_such(cell: Cell) -> None:
    mover: Any = cell
    route = [Waypoint(what="the target", position_m=np.array([1e308, 0.0, 0.3]))]
    with pytest.raises(InvalidInputError):
        check_route(cell.host, mover, "The motion", route, 1.0)


@pytest.mark.parametrize(
    ("at_m", "is_near"),
    [([9.9, 0.0], True), ([0.0, 10.1], False), ([math.nan, 0.0], False), ([-1e308, 0, 0], False)],
)
def test_places_are_near_the_base_and_numbers(at_m: list[float], is_near: bool) -> None:
    if is_near:
        check_near(np.array(at_m), "at")
        return
    with pytest.raises(InvalidInputError):
        check_near(np.array(at_m), "at")

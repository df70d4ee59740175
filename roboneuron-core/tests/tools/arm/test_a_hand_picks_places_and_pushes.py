"""pick, place and push from the look before to the look after, with an arm that does what it is
told: nothing moves where something speaks against it, and what happened is told.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from handling_cell import EDGE_M, Cell, cube, pick, place, push

from roboneuron import InvalidInputError, NotReadyError, RefusedError, StateError
from roboneuron.tools.arm.picking import PickArguments, target_of


def test_an_object_is_lifted_and_the_grasp_is_told(cell: Cell) -> None:
    picked = pick(cell, object="red")
    assert (picked.object, picked.holds, cell.holds) == ("red cube", True, "red")
    assert picked.grasped_at_m == pytest.approx([0.5, 0.0, EDGE_M / 2], abs=1e-3)
    assert cell.cubes["red"].position_m[2] > 0.1
    assert (picked.others_moved, picked.not_seen_after) == ([], [])


HALF = EDGE_M / 2


@pytest.mark.parametrize(
    ("place_m", "meant"),
    [
        ((0.5, 0.0, HALF), "red"),
        ((0.5 + HALF, HALF, EDGE_M), "red"),
        ((0.5 - HALF, 0.0, 0.001), "red"),
        ((0.5, 0.0, 0.0), "red"),
        ((0.5 + HALF + 0.009, 0.0, HALF), "red"),
        ((0.5, 0.0, EDGE_M + 0.012), ""),
        ((0.5 + HALF + 0.012, 0.0, HALF), ""),
        ((0.5, -0.15, EDGE_M - 0.004), "blue"),
        ((0.5, -0.15, EDGE_M + 0.004), "green"),
        ((0.5, -0.15, EDGE_M), ""),
        ((0.5 + HALF, -0.15, 2 * EDGE_M), "green"),
    ],
)
def test_a_position_means_the_object_on_whose_surface_it_is(
    place_m: tuple[float, ...], meant: str
) -> None:
    """As `locate` tells it for any pixel of the object; between two that are as near, neither."""
    upper = cube("green", 0.5, -0.15)
    upper = replace(upper, position_m=upper.position_m + np.array([0.0, 0.0, EDGE_M]))
    stacked = Cell(cube("red", 0.5), cube("blue", 0.5, -0.15), upper)
    arguments = PickArguments(position_m=list(place_m))
    if meant:
        assert target_of(arguments, stacked, "agent")[1].colour == meant
    else:
        with pytest.raises(InvalidInputError) as refused:
            target_of(arguments, stacked, "agent")
        assert refused.value.path == "position_m"


@pytest.mark.parametrize("act", ["pick", "place", "push"])
def test_the_highest_speed_of_all_moves_is_told(cell: Cell, act: str) -> None:
    done = pick(cell, object="red") if act != "push" else push(cell, object="red", dx_m=0.06)
    if act == "place":
        done = place(cell, position_m=[0.5, 0.25])
    assert done.max_tcp_speed_m_s == len(cell.moves) / 100


def test_what_was_displaced_on_the_way_is_told(cell: Cell) -> None:
    cell.bumps = "green"
    (moved,) = pick(cell, object="red").others_moved
    assert (moved.object, moved.by_m) == ("green cube", pytest.approx(0.01))


def test_a_held_object_is_put_beside_and_on_others_and_back_on_the_table(cell: Cell) -> None:
    pick(cell, object="red")
    placed = place(cell, on="blue")
    assert (placed.object, placed.holding) == ("red cube", False)
    assert cell.cubes["red"].position_m == pytest.approx(
        [0.45, -0.15, 1.5 * EDGE_M + 0.002], abs=0.005
    )
    pick(cell, object="red")
    placed = place(cell, beside="green", side="-x", gap_m=0.04)
    assert placed.gap_m == pytest.approx(0.04, abs=0.005)
    apart = cell.cubes["green"].position_m - cell.cubes["red"].position_m
    assert apart[:2] == pytest.approx([EDGE_M + 0.04, 0.0], abs=0.005)
    assert cell.cubes["red"].position_m[2] == pytest.approx(EDGE_M / 2, abs=0.005)
    pick(cell, object="red")
    placed = place(cell, position_m=[0.55, 0.0])
    assert placed.placed_at_m == pytest.approx([0.55, 0.0, EDGE_M / 2], abs=0.006)
    assert placed.error_m <= 0.006


def test_a_shifted_place_of_an_unstacked_object_ends_on_the_table(cell: Cell) -> None:
    on_blue = cell.cubes["blue"].position_m + np.array([0.0, 0.0, EDGE_M])
    cell.cubes["red"] = replace(cell.cubes["red"], position_m=on_blue)
    pick(cell, object="red")
    place(cell, dx_m=0.1)
    assert cell.cubes["red"].position_m[2] == pytest.approx(EDGE_M / 2, abs=0.005)


def test_an_object_is_pushed_and_corrected_until_it_is_there(cell: Cell) -> None:
    pushed = push(cell, object="red", dx_m=0.06)
    assert pushed.pushes > 1
    assert pushed.error_m <= 0.005
    assert cell.cubes["red"].position_m[0] == pytest.approx(0.56, abs=0.005)
    assert set(cell.forgotten) == {"red"}


def test_a_push_that_misses_is_an_error_that_says_what_is_left(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    carry = cell.carry

    def overshoot(delta: Any) -> None:
        before = cell.cubes["red"].position_m
        carry(delta)
        slid = cell.cubes["red"].position_m - before
        cell.cubes["red"] = replace(cell.cubes["red"], position_m=before + 2.0 * slid)
        if np.any(slid):
            cell.is_reachable = False  # from the other side it cannot be pushed back

    monkeypatch.setattr(cell, "carry", overshoot)
    with pytest.raises(StateError) as missed:
        push(cell, object="red", dx_m=0.06)
    left_m = 0.56 - cell.cubes["red"].position_m[0]
    assert left_m < -0.01
    assert f"dx_m {left_m:.3f}" in str(missed.value.hint)


def test_a_pushed_object_that_is_seen_badly_keeps_its_height(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    look = cell.look

    def look_badly(who: str, newer_than_ns: int = 0) -> Any:
        seen = look(who, newer_than_ns)
        if not cell.moves:
            return seen
        (red, *others) = seen.objects
        sunk = red.position_m - np.array([0.0, 0.0, 0.011])
        vague = replace(red, position_m=sunk, is_whole=False, uncertainty_m=0.033)
        return replace(seen, objects=(vague, *others))

    monkeypatch.setattr(cell, "look", look_badly)
    pushed = push(cell, object="red", dx_m=0.06)
    assert pushed.position_m[2] == pytest.approx(EDGE_M / 2, abs=1e-4)


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"has_gripper": False}, "no_gripper"),
        ({"holds": "blue"}, "full_hand"),
        ({"is_policy_running": True}, "busy"),
        ({"is_reachable": False}, "out_of_reach"),
    ],
)
def test_nothing_moves_where_something_speaks_against_it(
    cell: Cell, change: dict[str, Any], rule: str
) -> None:
    for name, value in change.items():
        setattr(cell, name, value)
    with pytest.raises(RefusedError) as refusal:
        pick(cell, object="red")
    assert refusal.value.rule == rule
    with pytest.raises(RefusedError) as refusal:
        push(cell, object="red", dx_m=0.05)
    assert refusal.value.rule == rule
    assert cell.moves == []


@pytest.mark.parametrize(
    "problem",
    [
        "It is not calibrated for pictures of this size: it tells no places.",
        "Its newest picture is 9.0 s old. See get_status, perception.",
        "It sends no picture. Call start_perception first.",
    ],
)
def test_without_sight_nothing_moves_and_the_reason_is_told(cell: Cell, problem: str) -> None:
    cell.problems = {"front": problem}
    for attempt, more in ((pick, {}), (push, {"dx_m": 0.1})):
        with pytest.raises(NotReadyError) as refusal:
            attempt(cell, object="red", **more)
        assert problem in str(refusal.value)
    assert cell.moves == []


def test_a_hand_that_closes_on_nothing_says_so(cell: Cell) -> None:
    cell.is_slippery = True
    with pytest.raises(StateError, match="holds nothing"):
        pick(cell, object="red")


@pytest.mark.parametrize("count", [1, 3])
def test_what_is_left_of_a_route_is_not_made_after_a_stop(cell: Cell, count: int) -> None:
    cell.stops_after = count
    with pytest.raises(StateError, match="stopped"):
        pick(cell, object="red")
    assert len(cell.moves) == count

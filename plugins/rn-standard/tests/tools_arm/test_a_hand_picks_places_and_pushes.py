"""pick, place and push from the look before to the look after, with an arm that does what it is
told: nothing moves where something speaks against it, and what happened is told.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import anyio
import numpy as np
import pytest

from rn_standard.sight.cell_view import CellView
from rn_standard.sight.locator import LocatedObject
from rn_standard.sight.marks import CellLook
from rn_standard.tools_arm import picking, place_plans, pushing
from rn_standard.tools_arm.options import HandOptions
from rn_standard.tools_arm.picking import PickArguments, Picker
from rn_standard.tools_arm.place_plans import PlaceArguments
from rn_standard.tools_arm.placing import Placer
from rn_standard.tools_arm.pushing import PushArguments, Pusher
from rn_standard.tools_arm.put_down import HeldObject
from roboneuron import NotReadyError, Pose, RefusedError, StateError

EDGE_M = 0.044
DOWN = np.array([1.0, 0.0, 0.0, 0.0])


def cube(colour: str, x_m: float, y_m: float = 0.0) -> LocatedObject:
    return LocatedObject(
        label="cube",
        colour=colour,
        position_m=np.array([x_m, y_m, EDGE_M / 2]),
        yaw_rad=0.0,
        symmetry_rad=np.pi / 2,
        size_m=np.full(3, EDGE_M),
        uncertainty_m=0.002,
        cameras=("above",),
        seen_at_ns=1,
    )


class Cell:
    """An arm with a hand over cubes, the feature that looks, and the host of both.

    Attributes:
        cubes: by colour.
        holds: what the hand holds.
        is_slippery: closed fingers grasp nothing.
        stops_after: number of moves after which the arm is stopped.
        bumps: a cube that each motion displaces by 1 cm.
        problems: of the cameras.
    """

    table_m = 0.0
    robot = "arm"
    arm = ""
    fastest = (0.25, 1.0)

    def __init__(self, *cubes: LocatedObject) -> None:
        self.cubes = {one.colour: one for one in cubes}
        self.holds: str | None = None
        self.has_gripper, self.is_slippery, self.is_policy_running = True, False, False
        self.position = np.array([0.3, 0.0, 0.4])
        self.opening = 1.0
        self.moves: list[Any] = []
        self.stops = 0
        self.stops_after = 10_000
        self.bumps = ""
        self.problems: dict[str, str] = {}
        self.held: HeldObject | None = None
        self.closed_at_m: float | None = None
        self.is_reachable = True

    # the feature that looks
    def look(self, who: str, newer_than_ns: int = 0) -> CellLook:
        images: Any = () if self.problems else (object(),)
        view = CellView(
            images=images, frames=(), problems=self.problems, tcps={}, taken_ns=1, taken_s=0.0
        )
        self._last = CellLook(view=view, objects=tuple(self.cubes.values()))
        return self._last

    def last_look(self, who: str) -> CellLook | None:
        return self._last

    # the grip
    def check_fitted(self) -> None:
        if not self.has_gripper:
            raise RefusedError("This robot has no gripper.", rule="no_gripper")

    def holding(self) -> bool:
        return self.holds is not None

    def measured(self) -> float:
        return EDGE_M / 0.08 if self.holds else self.opening

    # the mover
    def check(self) -> None:
        if self.is_policy_running:
            raise RefusedError("The policy moves it.", rule="busy")

    def pose(self) -> Pose:
        return Pose(position_m=self.position, quaternion_xyzw=DOWN)

    async def __call__(self, move: Any, context: Any) -> Any:
        self.moves.append(move)
        delta = np.array([move.dx_m, move.dy_m, move.dz_m])
        self.position = self.position + delta
        self._carry(delta)
        if move.gripper_open is not None:
            self._grip(move.gripper_open)
        if len(self.moves) >= self.stops_after:
            self.stops = 1
        return SimpleNamespace(simulated=False, allowed=True, reason="", holding=self.holding())

    def _carry(self, delta: Any) -> None:
        for colour, one in self.cubes.items():
            near = np.linalg.norm(one.position_m[:2] - self.position[:2]) < 0.034
            is_low = self.position[2] < EDGE_M
            pushed = near and is_low and self.opening == 0.0 and self.holds is None
            if colour == self.holds:
                self.cubes[colour] = replace(one, position_m=one.position_m + delta)
            elif pushed and np.linalg.norm(delta[:2]) > 0.012:
                far_m = float(np.linalg.norm(delta[:2]))
                # 2 cm before contact, and a fifth is lost
                share = 0.8 * (far_m - 0.02) / far_m
                at = one.position_m + share * np.array([*delta[:2], 0.0])
                self.cubes[colour] = replace(one, position_m=at)
            elif colour == self.bumps and self.holds:
                shifted = one.position_m + np.array([0.01, 0.0, 0.0])
                self.cubes[colour], self.bumps = replace(one, position_m=shifted), ""

    def _grip(self, opening: float) -> None:
        self.opening = opening
        if opening > 0.5:
            self.holds = None
        elif not self.is_slippery:
            near = [
                name
                for name, one in self.cubes.items()
                if np.linalg.norm(one.position_m - self.position) < 0.01
            ]
            self.holds = near[0] if near else None

    @property
    def host(self) -> Any:
        return SimpleNamespace(features=SimpleNamespace(loaded={"sight": self}))


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch) -> Cell:
    made = Cell(cube("red", 0.5), cube("green", 0.5, 0.12), cube("blue", 0.45, -0.15))

    def rehearse(mover: Any, route: Any, speed: float) -> float:
        if not made.is_reachable:
            raise RefusedError("The elbow would stretch.", rule="path")
        return 1.0

    for module in (picking, place_plans, pushing):
        monkeypatch.setattr(module, "rehearse", rehearse)
    return made


def call(handler: Any, arguments: Any) -> Any:
    async def run(work: Any, **_: Any) -> Any:
        return work(lambda _: None)

    context = SimpleNamespace(who="agent", role="operator", simulated=False, run=run)
    return anyio.run(handler, arguments, context)


def pick(cell: Cell, **arguments: Any) -> Any:
    arm: Any = cell

    def remember(grasp: Any) -> None:
        cell.held = HeldObject.seen(grasp.object, grasp.position_m, grasp.yaw_rad)

    picker = Picker(cell.host, arm, arm, HandOptions(), remember)
    return call(picker, PickArguments(**arguments))


def place(cell: Cell, **arguments: Any) -> Any:
    arm: Any = cell
    return call(Placer(arm, arm, cell.host), PlaceArguments(**arguments))


def push(cell: Cell, **arguments: Any) -> Any:
    arm: Any = cell
    return call(Pusher(cell.host, arm, arm, HandOptions()), PushArguments(**arguments))


def test_an_object_is_lifted_and_the_grasp_is_told(cell: Cell) -> None:
    picked = pick(cell, object="red")
    assert (picked.object, picked.holds, cell.holds) == ("red cube", True, "red")
    assert picked.grasped_at_m == pytest.approx([0.5, 0.0, EDGE_M / 2], abs=1e-3)
    assert cell.cubes["red"].position_m[2] > 0.1
    assert (picked.others_moved, picked.not_seen_after) == ([], [])


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
    place(cell, beside="green", side="-x", gap_m=0.04)
    apart = cell.cubes["green"].position_m - cell.cubes["red"].position_m
    assert apart[:2] == pytest.approx([EDGE_M + 0.04, 0.0], abs=0.005)
    assert cell.cubes["red"].position_m[2] == pytest.approx(EDGE_M / 2, abs=0.005)
    pick(cell, object="red")
    placed = place(cell, position_m=[0.55, 0.0])
    assert placed.placed_at_m == pytest.approx([0.55, 0.0, EDGE_M / 2], abs=0.006)


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

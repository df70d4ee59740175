"""A hand over cubes that does what it is told, the feature that looks, and calls of its tools."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import anyio
import numpy as np

from rn_testing.fakes.painted_table import painted
from roboneuron import LocatedObject, Pose, RefusedError
from roboneuron.config import LimitsConfig
from roboneuron.sight.cell_view import CellView
from roboneuron.sight.marks import CellLook
from roboneuron.tools.arm.options import HandOptions
from roboneuron.tools.arm.picking import PickArguments, Picker
from roboneuron.tools.arm.place_plans import PlaceArguments
from roboneuron.tools.arm.placing import Placer
from roboneuron.tools.arm.pushing import PushArguments, Pusher
from roboneuron.tools.arm.put_down import HeldObject

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
        slips_to_m: where an object ends that the hand lets go; None: where it is.
        problems: of the cameras.
        hidden_below_m: height of the hand up to which it hides a cube, by colour.
    """

    table_m = 0.0
    held_name = "something"
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
        self.slips_to_m: Any = None
        self.forgotten: list[str] = []
        self.hidden_below_m: dict[str, float] = {}
        self.problems: dict[str, str] = {}
        self.held: HeldObject | None = None
        self.closed_at_m: float | None = None
        self.is_reachable = True
        self.limits = LimitsConfig()

    # the feature that looks
    def look(self, who: str, newer_than_ns: int = 0) -> CellLook:
        images: Any = () if self.problems else tuple(painted({}))
        view = CellView(
            images=images, frames=(), problems=self.problems, tcps={}, taken_ns=1, taken_s=0.0
        )
        objects = tuple(self._seen(one) for one in self.cubes.values())
        self._last = CellLook(view=view, objects=objects)
        return self._last

    def _seen(self, one: LocatedObject) -> LocatedObject:
        if self.position[2] > self.hidden_below_m.get(one.colour, -1.0):
            return one
        shifted = one.position_m + np.array([-0.03, 0.0, 0.0])
        vague = {"yaw_rad": None, "uncertainty_m": 0.066, "is_whole": False}
        return replace(one, position_m=shifted, **vague)

    def forget(self, one: LocatedObject) -> None:
        self.forgotten.append(one.colour)

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
        self.carry(delta)
        if move.gripper_open is not None:
            self._grip(move.gripper_open)
        if len(self.moves) >= self.stops_after:
            self.stops = 1
        return SimpleNamespace(
            simulated=False,
            allowed=True,
            reason="",
            holding=self.holding(),
            robot=self.robot,
            arm=self.arm,
            max_tcp_speed_m_s=len(self.moves) / 100,
            position_m=self.position.tolist(),
        )

    def carry(self, delta: Any) -> None:
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
            if self.holds and self.slips_to_m is not None:
                end = np.array(self.slips_to_m)
                self.cubes[self.holds] = replace(self.cubes[self.holds], position_m=end)
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
        return SimpleNamespace(
            features=SimpleNamespace(loaded={"sight": self}),
            loop=SimpleNamespace(limits=self.limits),
            modules=SimpleNamespace(tightened=None),
        )


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

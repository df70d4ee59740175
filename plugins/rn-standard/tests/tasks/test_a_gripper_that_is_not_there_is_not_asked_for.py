"""A task that is judged by a gripper, and a place that opens one, are refused for an arm that has
none: at once, before anything moves.
"""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from rn_standard.tasks.moving import Mover
from rn_standard.tasks.named_targets import Places
from rn_standard.tasks.options import PlaceOptions, TaskOptions, TasksSections
from rn_standard.tasks.run_task import RunTask, TaskTool
from roboneuron import ArmProfile, GripperProfile, RobotProfile
from roboneuron.errors import RefusedError

GRIPPER = GripperProfile(joint="finger", closed_position=0.0, open_position=0.04)
HOLDS = {"kind": "gripper_holds"}


def single(gripper: GripperProfile | None) -> RobotProfile:
    return RobotProfile(name="one", arm_joints=("a",), gripper=gripper)


def pair(left: GripperProfile | None, right: GripperProfile | None) -> RobotProfile:
    arms = tuple(
        ArmProfile(name=name, joints=(name,), base_link="b", tcp_link=name, gripper=gripper)
        for name, gripper in (("left", left), ("right", right))
    )
    return RobotProfile(name="pair", arm_joints=("left", "right"), arms=arms, gripper=left)


CASES: dict[str, tuple[RobotProfile, dict[str, str], dict[str, bool]]] = {
    "fitted": (single(GRIPPER), {}, {"": True}),
    "none": (single(None), {}, {"": False}),
    "undriven": (single(GRIPPER), {"no_gripper": "true"}, {"": False}),
    "both": (pair(GRIPPER, GRIPPER), {}, {"": True, "left": True, "right": True}),
    "left none": (pair(None, GRIPPER), {}, {"": False, "left": False, "right": True}),
    "right none": (pair(GRIPPER, None), {}, {"": True, "left": True, "right": False}),
    "left undriven": (
        pair(GRIPPER, GRIPPER),
        {"left/no_gripper": "true"},
        {"": False, "left": False, "right": True},
    ),
}
"""Profile, what the driver reports, and whether the gripper of an arm is there."""
ROWS = [
    pytest.param(profile, detail, arm, there, id=f"{case}-{arm or 'unnamed'}")
    for case, (profile, detail, arms) in CASES.items()
    for arm, there in arms.items()
]


class AskedError(Exception):
    """The call came as far as a person, or the arm."""


class Cell:
    """A running robot; whoever is asked to do something raises AskedError."""

    def __init__(self, profile: RobotProfile, detail: dict[str, str]) -> None:
        view = SimpleNamespace(report=SimpleNamespace(detail=detail))
        exposed = SimpleNamespace(profile=profile, robot=profile.name)
        self.host: Any = SimpleNamespace(
            tools={},
            config=SimpleNamespace(robot=SimpleNamespace(name=profile.name)),
            gate=SimpleNamespace(exposed=(exposed,)),
            modules=SimpleNamespace(view=lambda kind: view, require_running=lambda kind: view),
            loop=SimpleNamespace(
                starts=SimpleNamespace(
                    arm_stops=0, reason="", claims=SimpleNamespace(admit=nullcontext)
                )
            ),
        )

    async def ask(self, *_: object, **__: object) -> None:
        raise AskedError

    def run_task(self, until: dict[str, Any]) -> None:
        tool = TaskTool(
            self.host,
            TaskOptions(),
            arbiter=None,  # type: ignore[arg-type]
            move_to=None,  # type: ignore[arg-type]
            names=list,
            ended=lambda *_: None,
            failed=lambda *_: None,
            contrary=lambda *_: None,
        )
        anyio.run(tool, RunTask(instruction="try", until=until), SimpleNamespace(run=self.ask))

    def move_to(self, place: PlaceOptions) -> None:
        def pose(arm: str) -> Any:
            raise AskedError

        async def run(work: Any) -> Any:
            return work(lambda _: None)

        places = Places(self.host, TasksSections(places={"there": place}))
        anyio.run(Mover(self.host, places, pose), "there", SimpleNamespace(run=run))


def expected(is_there: bool) -> Any:
    return pytest.raises(AskedError if is_there else RefusedError)


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize(("profile", "detail", "arm", "is_there"), ROWS)
def test_a_task_is_not_judged_by_a_gripper_that_is_not_there(
    profile: RobotProfile, detail: dict[str, str], arm: str, is_there: bool, nested: bool
) -> None:
    holds = {**HOLDS, "arm": arm}
    until = {"kind": "held", "for_s": 1, "of": holds} if nested else holds
    with expected(is_there) as ended:
        Cell(profile, detail).run_task(until)
    assert is_there or ended.value.rule == "no_gripper"


@pytest.mark.parametrize(("profile", "detail", "arm", "is_there"), ROWS)
def test_no_arm_moves_to_a_place_where_a_gripper_would_open_that_is_not_there(
    profile: RobotProfile, detail: dict[str, str], arm: str, is_there: bool
) -> None:
    if profile.arms and not arm:
        return  # a place names one of several arms
    there = PlaceOptions(position_m=(0.4, 0.0, 0.4), gripper_open=1.0, arm=arm)
    with expected(is_there) as ended:
        Cell(profile, detail).move_to(there)
    assert is_there or ended.value.rule == "no_gripper"


@pytest.mark.parametrize("case", ["none", "undriven", "left none"])
def test_a_place_without_an_opening_is_for_every_arm(case: str) -> None:
    profile, detail, _ = CASES[case]
    arm = profile.arms[0].name if profile.arms else ""
    with expected(is_there=True):
        Cell(profile, detail).move_to(PlaceOptions(position_m=(0.4, 0.0, 0.4), arm=arm))

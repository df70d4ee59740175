"""What pick has grasped and place has put down stays known when the rest of the call ends early."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from handling_cell import Cell, cube, pick, place

from roboneuron.contract import GripperProfile, RobotProfile
from roboneuron.errors import NotReadyError, StateError
from roboneuron.modules.report import Report
from roboneuron.server import clock
from roboneuron.tools.arm.grip_height import GripHeight
from roboneuron.tools.arm.put_down import HeldObject

HELD = HeldObject.seen(cube("red", 0.4), np.array([0.4, 0.0, 0.02]), 0.0)
PROFILE = RobotProfile(
    name="arm",
    arm_joints=("j1",),
    gripper=GripperProfile(joint="finger", closed_position=0.0, open_position=0.04),
)


def test_what_a_stopped_pick_has_grasped_can_be_placed_on_another(cell: Cell) -> None:
    whole = Cell(*cell.cubes.values())
    pick(whole, object="red")
    closing = next(n for n, move in enumerate(whole.moves, 1) if move.gripper_open == 0.0)
    cell.stops_after = closing
    with pytest.raises(StateError, match="stopped"):
        pick(cell, object="red")
    assert cell.holds == "red"
    cell.stops_after, cell.stops = 10_000, 0
    assert place(cell, on="blue").object == "red cube"


def test_an_error_after_the_release_says_that_the_object_is_put_down(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    pick(cell, object="red")
    look = cell.look

    def look_once(who: str, newer_than_ns: int = 0) -> Any:
        if cell.holds is None:
            raise NotReadyError("No picture comes.", hint="Look again.")
        return look(who, newer_than_ns)

    monkeypatch.setattr(cell, "look", look_once)
    with pytest.raises(NotReadyError) as late:
        place(cell, on="blue")
    assert '"red cube" is put down already.' in str(late.value.hint)


@pytest.mark.parametrize(
    ("reported", "is_known"),
    [
        ([1.0, 1.0, 0.0], True),  # the report comes late
        ([0.0], True),
        ([0.0, 0.02], True),
        ([1.0, 0.0, 1.0], False),
        ([0.0, 0.3], False),
        ([None, 0.0, None], True),
    ],
)
def test_it_is_known_until_the_hand_is_commanded_otherwise(
    reported: list[float | None], is_known: bool
) -> None:
    listeners: list[Any] = []
    now: dict[str, float | None] = {"opening": 1.0}

    def view(kind: str) -> Any:
        opening = now["opening"]
        metrics = {} if opening is None else {"gripper_commanded": f"{opening:g}"}
        return SimpleNamespace(report=Report(metrics=metrics, detail={}, note=""), phase="running")

    host: Any = SimpleNamespace(
        modules=SimpleNamespace(view=view, require_running=lambda kind: None),
        clock=lambda namespace: clock.RobotClock(),
        config=SimpleNamespace(namespace="arm"),
    )
    exposed: Any = SimpleNamespace(robot="arm", namespace="arm", profile=PROFILE)
    tcp: Any = SimpleNamespace(listeners=listeners, open=lambda: None)
    grip = GripHeight(host, tcp, exposed, tcp)
    grip.watch()
    listeners[0](0.3)
    grip.hold(HELD)
    for now["opening"] in reported:
        listeners[0](0.02)
    assert (grip.held is not None) == is_known

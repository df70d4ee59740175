"""A task tells which other objects it has moved, as far as both looks show them, and begins with
no hand that would drop something.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rn_standard.tasks.task_result import told_reason
from roboneuron import LocatedObject, NotReadyError, RefusedError
from roboneuron.config import Config
from roboneuron.server.clock import RobotClock
from roboneuron.sight.marks import CellLook
from roboneuron.tools.arm.displacement import SceneWatch

RED, GREEN = (0.5, 0.0, 0.02), (0.5, 0.1, 0.02)


def cube(colour: str, place: tuple[float, float, float]) -> LocatedObject:
    return LocatedObject(
        label="cube",
        colour=colour,
        position_m=np.array(place),
        yaw_rad=0.0,
        symmetry_rad=np.pi / 2,
        size_m=np.full(3, 0.04),
        uncertainty_m=0.001,
        cameras=("front",),
        seen_at_ns=1,
    )


class Eyes:
    """The feature sight: each look shows what is on the table now."""

    table_m = 0.0

    def __init__(self, table: Mapping[str, tuple[float, float, float]], *, blind: bool = False):
        self.table, self.blind, self.asked = dict(table), blind, []
        self.holds: dict[str, str] = {"": ""}

    def look(self, who: str, newer_than_ns: int = 0) -> CellLook:
        self.asked.append(newer_than_ns)
        if self.blind:
            raise NotReadyError("No camera.")
        view: Any = SimpleNamespace(images=("front",))
        objects = tuple(cube(colour, place) for colour, place in self.table.items())
        held = {
            arm: next(one for one in objects if one.colour == colour)
            for arm, colour in self.holds.items()
            if colour
        }
        hands: Any = dict.fromkeys(self.holds)
        return CellLook(view=view, objects=objects, held=held, hands=hands)

    def forget(self, one: LocatedObject) -> None: ...

    def last_look(self, who: str) -> None: ...


def scene(eyes: Eyes | None) -> SceneWatch:
    loaded = {} if eyes is None else {"sight": eyes}
    host: Any = SimpleNamespace(
        features=SimpleNamespace(loaded=loaded),
        clock=lambda namespace: RobotClock(),
        config=Config.model_validate({"robot": {"name": "arm"}}),
    )
    return SceneWatch(host, "pick up the red cube", "agent")


@pytest.mark.parametrize(
    ("after", "moved"),
    [
        ({"red": (0.5, 0.0, 0.3), "green": GREEN}, {}),
        ({"red": (0.5, 0.0, 0.3), "green": (0.5, 0.12, 0.02)}, {"green cube": 0.02}),
        ({"red": RED, "green": (0.5, 0.101, 0.02)}, {}),  # within what is seen
        ({"red": RED}, None),  # hidden: not known
    ],
)
def test_others_that_moved_are_told(
    after: dict[str, tuple[float, float, float]], moved: dict[str, float] | None
) -> None:
    eyes = Eyes({"red": RED, "green": GREEN})
    watched = scene(eyes)
    watched.look_before()
    eyes.table = after
    assert watched.moved() == (None if moved is None else pytest.approx(moved))
    assert eyes.asked[0] == 0
    assert eyes.asked[1] > 0, "the second look takes pictures of after the task"


@pytest.mark.parametrize(
    ("holds", "is_refused"),
    [
        ({"": ""}, False),
        ({"": "red"}, False),
        ({"": "green"}, True),
        ({"left": "green", "right": ""}, False),
        ({"left": "green", "right": "red"}, False),
        ({"left": "green", "right": "green"}, True),
    ],
    ids=str,
)
def test_nothing_is_grasped_while_every_hand_holds_something_else(
    holds: dict[str, str], is_refused: bool
) -> None:
    eyes = Eyes({"red": RED, "green": GREEN})
    eyes.holds = holds
    watched = scene(eyes)
    watched.look_before()
    if not is_refused:
        watched.check_hands()
        return
    with pytest.raises(RefusedError, match="green cube") as refused:
        watched.check_hands()
    assert refused.value.rule == "full_hand"


@pytest.mark.parametrize("eyes", [None, Eyes({}, blind=True)], ids=["none", "blind"])
def test_it_is_not_known_where_nothing_looks(eyes: Eyes | None) -> None:
    watched = scene(eyes)
    watched.look_before()
    watched.check_hands()
    assert watched.moved() is None


def test_the_reason_names_them() -> None:
    assert told_reason("it is held", None) == "it is held."
    assert told_reason("it is held", {}) == "it is held."
    assert told_reason("it is held", {"green cube": 0.021}).endswith("green cube by 2.1 cm.")

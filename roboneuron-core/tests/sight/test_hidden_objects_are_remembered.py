"""An object that the arm hides keeps its last good sighting; one that is gone, moved or held does
not.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from painted_cell import CAMERAS, PaintedCell

from roboneuron import CameraView
from roboneuron.sight.marks import CellLook

RED, GREEN = (0.5, 0.1, 0.3), (0.42, -0.1, -0.2)
OVER_RED, AWAY = (0.5, 0.1, 0.06), (0.3, -0.5, 0.6)


class Watched:
    """A cell that is looked at again and again."""

    def __init__(self, **cell: Any) -> None:
        self.cell = PaintedCell(cubes={"red": RED, "green": GREEN}, tcps={"": AWAY}, **cell)
        self.feature, self.tools = self.cell.sight()

    def look(self) -> CellLook:
        return self.feature.look("agent")

    def names(self) -> set[str]:
        return {one.colour for one in self.look().objects}

    def cover(self, colour: str, x_m: float, y_m: float) -> None:
        """Cover that half of a cube in each picture that is on the right."""
        for name, camera in CAMERAS.items():
            centre = CameraView.of(camera, np.eye(4)).project(np.array([x_m, y_m, 0.022]))
            column, row = centre.astype(int).tolist()
            self.cell.patches[name] = (slice(row - 20, row + 20), slice(column, column + 20))


def test_what_the_arm_covers_stays_where_it_was_seen_and_says_so() -> None:
    watched = Watched()
    before = next(one for one in watched.look().objects if one.colour == "red")
    del watched.cell.cubes["red"]
    watched.cell.tcps = {"": OVER_RED}
    answer = watched.cell.call(watched.tools["look"]).result
    told = next(one for one in answer.objects if one.name == "red cube")
    assert told.position_m == pytest.approx(before.position_m.tolist(), abs=1e-4)
    assert any(note.startswith("hidden") for note in told.notes)
    look = watched.look()
    assert [one.colour for one in look.hidden] == ["red"]
    assert not any(look.is_certain(one) for one in look.hidden)


def test_what_is_gone_from_a_place_in_plain_view_is_forgotten() -> None:
    watched = Watched()
    watched.look()
    del watched.cell.cubes["red"]
    assert watched.names() == {"green"}
    watched.cell.tcps = {"": OVER_RED}
    assert watched.names() == {"green"}


def test_a_half_hidden_object_keeps_its_place_and_one_that_moved_does_not() -> None:
    watched = Watched()
    before = next(one for one in watched.look().objects if one.colour == "red")
    watched.cover("red", *RED[:2])
    look = watched.look()
    red = next(one for one in look.objects if one.colour == "red")
    assert red in look.hidden
    assert np.linalg.norm(red.position_m - before.position_m) < 1e-6
    watched.cell.cubes["red"] = (0.6, 0.02, 0.3)
    watched.cover("red", 0.6, 0.02)
    look = watched.look()
    assert all(one.colour != "red" or one not in look.hidden for one in look.objects)


@pytest.mark.parametrize("cause", ["robot stops", "instruction", "forget"])
def test_what_may_have_been_moved_is_forgotten(cause: str) -> None:
    watched = Watched()
    red = next(one for one in watched.look().objects if one.colour == "red")
    if cause == "robot stops":
        watched.cell.robot = "stopped"
        watched.cell.events.change.tell("robot")
    elif cause == "instruction":
        call = SimpleNamespace(arguments={"instruction": "pick up the red cube"})
        watched.cell.events.call_ended.tell(SimpleNamespace(call=call))
    else:
        watched.feature.forget(red)
    del watched.cell.cubes["red"]
    watched.cell.tcps = {"": OVER_RED}
    assert watched.names() == {"green"}


@pytest.mark.parametrize("cameras", [("above",), ("side",)])
def test_a_held_object_that_one_camera_shows_is_in_the_hand_and_not_on_the_table(
    cameras: tuple[str, ...],
) -> None:
    watched = Watched(
        ages_s=dict.fromkeys(cameras, 0.0), opening=0.5, commanded=0.0, mounts={"side": "base"}
    )
    eye = CAMERAS[cameras[0]].T_mount_camera[:3, 3]
    on_table = np.array([*RED[:2], 0.022])
    hand = on_table + 0.25 * (eye - on_table)
    watched.cell.tcps = {"": hand.tolist()}
    answer = watched.cell.call(watched.tools["look"]).result
    assert [one.holds for one in answer.hands] == ["red cube"]
    red = next(one for one in answer.objects if one.name == "red cube")
    assert red.position_m == pytest.approx(hand.tolist(), abs=0.02)
    assert red.uncertainty_m > 0.02
    assert "in the hand" in red.notes


def test_what_one_camera_sees_past_an_arm_is_told_with_the_doubt_of_a_cut_outline() -> None:
    watched = Watched(ages_s={"above": 0.0}, mounts={"above": "base"})
    free = next(one for one in watched.look().objects if one.colour == "red")
    watched.feature.forget(free)
    watched.cell.tcps = {"": OVER_RED}
    past = next(one for one in watched.look().objects if one.colour == "red")
    assert len(past.cameras) == 1
    assert free.uncertainty_m < past.uncertainty_m <= 0.012, "it is still acted on"
    assert past.uncertainty_m == pytest.approx(free.size_m.min() / 4, rel=0.2)

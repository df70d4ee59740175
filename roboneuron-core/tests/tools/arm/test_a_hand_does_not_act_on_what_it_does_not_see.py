"""What is hidden, missed or forbidden is told as such, and nothing is done on a guess."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from handling_cell import EDGE_M, Cell, pick, place, push

from rn_testing.fakes.painted_table import painted
from roboneuron import CalibratedImage, RefusedError
from roboneuron.config import LimitsConfig
from roboneuron.sight.sightlines import HandSight
from roboneuron.tools.arm.displacement import displaced
from roboneuron.tools.arm.landing import MissedError, landed


@pytest.mark.parametrize("target", [{"on": "blue"}, {"position_m": [0.55, 0.0]}])
@pytest.mark.parametrize("lies_at_m", [[0.53, -0.08, EDGE_M / 2], [0.3, 0.3, EDGE_M / 2]])
def test_an_object_that_ends_elsewhere_is_a_miss_with_its_place(
    cell: Cell, target: dict[str, Any], lies_at_m: list[float]
) -> None:
    pick(cell, object="red")
    cell.slips_to_m = lies_at_m
    with pytest.raises(MissedError) as miss:
        place(cell, **target)
    assert miss.value.lies_at_m == pytest.approx(lies_at_m, abs=1e-3)
    assert miss.value.off_m > 0.02


def test_one_camera_alone_does_not_tell_a_stacked_object_from_one_behind_it(cell: Cell) -> None:
    before = cell.look("agent")
    one = before.objects[0]
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = [0.5, -0.5, 0.6]
    image = CalibratedImage(frame=painted({})[0].frame, T_base_camera=pose)
    meant_m = np.array([0.5, -0.15, 1.5 * EDGE_M])
    on_line = pose[:3, 3] + (meant_m - pose[:3, 3]) * (0.6 - EDGE_M / 2) / (0.6 - meant_m[2])
    told = {"is_height_assumed": True, "cameras": (image.frame.camera,)}
    seen = replace(one, position_m=on_line, **told)
    look = replace(before, objects=(seen,), view=replace(before.view, images=(image,)))
    assert landed(before, look, one, meant_m) is None
    with pytest.raises(MissedError):
        landed(before, look, one, meant_m + np.array([0.1, 0.0, 0.0]))


@pytest.mark.parametrize(("dy_m", "is_free"), [(0.12, False), (0.05, True)])
def test_a_shifted_place_of_what_a_policy_grasped_is_not_lowered_onto_another(
    cell: Cell, dy_m: float, is_free: bool
) -> None:
    cell.position = np.array([0.5, 0.0, 0.2])
    cell.cubes["red"] = replace(cell.cubes["red"], position_m=cell.position)
    cell.holds, cell.closed_at_m = "red", EDGE_M / 2
    if is_free:
        assert not place(cell, dy_m=dy_m).holding
        return
    with pytest.raises(RefusedError) as refusal:
        place(cell, dy_m=dy_m)
    assert refusal.value.rule == "occupied"
    assert (cell.holds, cell.moves) == ("red", [])


TARGETS = [{"on": "green"}, {"beside": "green", "side": "-x"}, {"position_m": [0.5, 0.03]}]


@pytest.mark.parametrize("target", TARGETS)
def test_the_hand_moves_aside_to_see_what_it_hides(cell: Cell, target: dict[str, Any]) -> None:
    pick(cell, object="red")
    cell.hidden_below_m = {"green": cell.position[2] + 0.05}
    placed = place(cell, **target)
    assert placed.placed_at_m
    assert placed.error_m < 0.006
    assert placed.others_moved is None, "where the hidden one was before is not known"


@pytest.mark.parametrize("target", TARGETS)
def test_what_stays_hidden_is_refused_as_unclear_and_nothing_is_let_go(
    cell: Cell, target: dict[str, Any]
) -> None:
    pick(cell, object="red")
    cell.hidden_below_m = {"green": 2.0}
    with pytest.raises(RefusedError) as refusal:
        place(cell, **target)
    assert refusal.value.rule == "unclear"
    assert cell.holds == "red"


def test_a_refusal_that_does_not_hang_on_what_is_hidden_keeps_its_rule(cell: Cell) -> None:
    pick(cell, object="red")
    cell.hidden_below_m = {"green": 2.0}
    with pytest.raises(RefusedError) as refusal:
        place(cell, position_m=[0.45, -0.15])
    assert refusal.value.rule == "occupied"


@pytest.mark.parametrize(("act", "more"), [(pick, {"yaw_deg": 0.0}), (push, {"dx_m": 0.05})])
def test_a_hidden_neighbour_keeps_nothing_from_being_picked_or_pushed(
    cell: Cell, act: Any, more: dict[str, Any]
) -> None:
    cell.hidden_below_m = {"green": cell.position[2] + 0.05}
    before = cell.cubes["red"].position_m
    act(cell, object="red", **more)
    assert np.linalg.norm(cell.cubes["red"].position_m - before) > 0.035


@pytest.mark.parametrize(
    ("act", "more"), [(pick, {}), (push, {"dx_m": 0.05}), (place, {"position_m": [0.5, 0.0]})]
)
@pytest.mark.parametrize(
    ("limits", "edge"),
    [
        ({"workspace_lower_m": [0.8, -1.0, 0.0], "workspace_upper_m": [2.0, 1.0, 1.0]}, "x >= 0.8"),
        ({"workspace_lower_m": [-1.0, -1.0, 0.0], "workspace_upper_m": [0.4, 1, 1]}, "x <= 0.4"),
        (
            {"zones": [{"name": "half", "lower_m": [0.4, -1, 0], "upper_m": [2, 1, 1]}]},
            "[0.4, -1.0, 0.0]",
        ),
    ],
)
def test_a_limit_that_forbids_the_route_is_named_with_its_edge(
    cell: Cell, act: Any, more: dict[str, Any], limits: dict[str, Any], edge: str
) -> None:
    if act is place:
        pick(cell, object="red")
    cell.is_reachable, cell.limits = False, LimitsConfig.model_validate(limits)
    with pytest.raises(RefusedError) as refusal:
        act(cell, **({} if act is place else {"object": "red"}), **more)
    assert refusal.value.rule == "workspace"
    assert edge in refusal.value.message


@pytest.mark.parametrize(
    ("hand_m", "is_told"), [((0.5, -0.2, 0.2), False), ((0.5, 0.4, 0.2), True)]
)
def test_an_outline_that_an_arm_may_cut_is_not_told_as_moved(
    cell: Cell, hand_m: tuple[float, float, float], is_told: bool
) -> None:
    before = cell.look("agent")
    one = before.objects[0]
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = [0.5, -0.5, 0.6]
    image = CalibratedImage(frame=painted({})[0].frame, T_base_camera=pose)
    seen = replace(
        one,
        position_m=one.position_m + np.array([0.009, 0.0, 0.0]),
        is_height_assumed=True,
        cameras=(image.frame.camera,),
    )
    hands = {"": HandSight(position_m=np.array(hand_m))}
    after = replace(
        before, objects=(seen,), view=replace(before.view, images=(image,)), hands=hands
    )
    told = displaced(replace(before, objects=(one,)), after, None)
    assert bool(told.others_moved) is is_told
    assert bool(told.not_seen_well) is not is_told

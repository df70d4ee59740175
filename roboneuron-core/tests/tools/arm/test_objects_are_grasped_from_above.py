"""Plans of grasps: what fits is grasped across its faces, what does not is refused with its rule
and the distance, and what the motion did to others is told.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from roboneuron import InvalidInputError, LocatedObject, Pose, RefusedError
from roboneuron.sight.cell_view import CellView
from roboneuron.sight.marks import CellLook
from roboneuron.tools.arm.displacement import displaced
from roboneuron.tools.arm.grasps import grasps_of, route_to_grasp
from roboneuron.tools.arm.hand_space import UprightBox, gap_m, nearest_obstacle, parts_of_hand
from roboneuron.tools.arm.options import HandOptions
from roboneuron.tools.arm.picking import PickArguments, target_of

HAND = HandOptions()
EDGE_M = 0.044


def cube(
    colour: str = "red",
    x_m: float = 0.5,
    y_m: float = 0.0,
    *,
    yaw_rad: float | None = 0.0,
    bottom_m: float = 0.0,
    size_m: Any = (EDGE_M, EDGE_M, EDGE_M),
    uncertainty_m: float = 0.002,
) -> LocatedObject:
    size = np.array(size_m)
    return LocatedObject(
        label="cube",
        colour=colour,
        position_m=np.array([x_m, y_m, bottom_m + size[2] / 2]),
        yaw_rad=yaw_rad,
        symmetry_rad=np.pi / 2,
        size_m=size,
        uncertainty_m=uncertainty_m,
        cameras=("above",),
        seen_at_ns=1,
    )


def look(*objects: LocatedObject) -> CellLook:
    view = CellView(images=(), frames=(), problems={}, tcps={}, taken_ns=1, taken_s=0.0)
    return CellLook(view=view, objects=objects)


def grasps(one: LocatedObject, *others: LocatedObject, yaw_rad: float | None = None) -> Any:
    return grasps_of(one, [UprightBox.of(other) for other in others], HAND, 0.0, yaw_rad)


def test_a_free_cube_is_grasped_at_its_middle_with_the_least_turn() -> None:
    first, *rest = grasps(cube(yaw_rad=0.3))
    assert first.yaw_rad == pytest.approx(0.3)
    assert first.position_m == pytest.approx([0.5, 0.0, EDGE_M / 2])
    assert first.opening == 1.0
    assert np.isinf(first.clearance_m)
    assert len(rest) == 3, "across either pair of faces, either way round"


def test_a_long_object_is_grasped_across_its_narrow_side() -> None:
    found = grasps(cube(size_m=(0.15, 0.04, 0.04)))
    # the hand closes along its y axis, the object's narrow one
    assert {abs(round(np.sin(grasp.yaw_rad), 6)) for grasp in found} == {0.0}


def test_a_neighbour_on_one_side_turns_the_hand_to_the_other_faces() -> None:
    red, green = cube(), cube("green", y_m=0.06)
    found = grasps(red, green)
    assert {abs(round(np.cos(grasp.yaw_rad), 6)) for grasp in found} == {0.0}
    assert all(grasp.clearance_m >= 0.003 for grasp in found)


def test_between_neighbours_the_hand_opens_narrowly() -> None:
    one = cube(uncertainty_m=0.001)
    others = [
        cube("green", y_m=0.085, uncertainty_m=0.001),
        cube("blue", y_m=-0.085, uncertainty_m=0.001),
        cube("yellow", x_m=0.585, uncertainty_m=0.001),
        cube("purple", x_m=0.415, uncertainty_m=0.001),
    ]
    found = grasps(one, *others)
    assert all(grasp.opening < 1.0 for grasp in found)
    assert all(grasp.opening * HAND.gap_m > EDGE_M + 0.01 for grasp in found)


def test_a_cube_on_another_is_grasped_above_it() -> None:
    top = cube("green", bottom_m=EDGE_M)
    first, *_ = grasps(top, cube())
    assert first.position_m[2] == pytest.approx(1.5 * EDGE_M)
    with pytest.raises(RefusedError) as refusal:
        grasps(cube(), top)
    assert refusal.value.rule == "covered"


def test_a_tall_stack_beside_it_is_in_the_way_of_the_palm() -> None:
    stack = [cube(name, y_m=0.09, bottom_m=n * EDGE_M) for n, name in enumerate(("blue", "green"))]
    found = grasps(cube(), *stack)
    # the palm is wide along the closing direction, so that must not be y
    assert {abs(round(np.cos(grasp.yaw_rad), 6)) for grasp in found} == {0.0}


@pytest.mark.parametrize(
    ("one", "others", "yaw_rad", "rule"),
    [
        (cube(size_m=(0.09, 0.10, 0.04)), (), None, "too_wide"),
        (cube(), (), np.pi / 4 + 0.001, ""),
        (cube(size_m=(0.06, 0.06, 0.04)), (), np.pi / 4, "too_wide"),
        (
            cube(),
            (
                cube("green", y_m=0.055),
                cube("blue", y_m=-0.055),
                cube("yellow", x_m=0.555),
                cube("purple", x_m=0.445),
            ),
            None,
            "too_close",
        ),
        (cube(), (cube("green", y_m=0.06),), 0.0, "too_close"),
        (cube(yaw_rad=None, uncertainty_m=0.03), (), None, "unclear"),
    ],
)
def test_what_cannot_be_grasped_is_refused_by_its_rule(
    one: LocatedObject, others: Any, yaw_rad: float | None, rule: str
) -> None:
    if not rule:
        assert grasps(one, *others, yaw_rad=yaw_rad)
        return
    with pytest.raises(RefusedError) as refusal:
        grasps(one, *others, yaw_rad=yaw_rad)
    assert refusal.value.rule == rule
    assert rule == "unclear" or any(letter.isdigit() for letter in refusal.value.message)


def test_no_part_of_an_allowed_grasp_overlaps_a_neighbour() -> None:
    random = np.random.default_rng(3)
    allowed = 0
    for _ in range(300):
        one = cube(yaw_rad=random.uniform(-0.8, 0.8))
        angle, far_m = random.uniform(0, 2 * np.pi), random.uniform(0.065, 0.14)
        other = cube(
            "green",
            0.5 + far_m * np.cos(angle),
            far_m * np.sin(angle),
            yaw_rad=random.uniform(-0.8, 0.8),
        )
        try:
            found = grasps(one, other)
        except RefusedError:
            continue
        allowed += 1
        for grasp in found:
            for part in parts_of_hand(
                grasp.position_m, grasp.yaw_rad, grasp.opening * HAND.gap_m, HAND
            ):
                if part.bottom_m < EDGE_M:
                    assert not _touches(part, UprightBox.of(other))
    assert allowed > 150


def _touches(one: UprightBox, other: UprightBox) -> bool:
    """Whether points of one box lie in the other."""
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 15), np.linspace(-1, 1, 15)), -1).reshape(-1, 2)
    points = one.centre + (grid * one.half) @ one.axes
    inside = np.abs((points - other.centre) @ other.axes.T) <= other.half
    return bool(inside.all(axis=1).any())


def test_distances_of_boxes_are_never_told_too_large() -> None:
    one = UprightBox.of(cube())
    beside = UprightBox.of(cube("green", y_m=0.1))
    assert gap_m(one, beside) == pytest.approx(0.1 - EDGE_M)
    turned = UprightBox.of(cube("green", y_m=0.1, yaw_rad=np.pi / 4))
    assert gap_m(one, turned) == pytest.approx(0.1 - EDGE_M / 2 - EDGE_M / np.sqrt(2))
    assert nearest_obstacle((one,), ()) == (np.inf, "")


def test_the_route_rises_above_all_objects_first_and_comes_down_with_the_hand_open() -> None:
    red, tall = cube(), cube("green", y_m=0.3, bottom_m=EDGE_M)
    grasp = grasps(red, tall)[0]
    low = Pose(position_m=np.array([0.3, 0.2, 0.03]), quaternion_xyzw=np.array([1.0, 0, 0, 0]))
    rise, above, down, lift = route_to_grasp(grasp, low, [UprightBox.of(tall)])
    assert rise.position_m is not None
    assert rise.position_m[:2] == pytest.approx([0.3, 0.2])
    for part in (rise, above, lift):
        assert part.position_m is not None
        assert part.position_m[2] > 2 * EDGE_M
    assert above.opening == grasp.opening
    assert (down.opening, down.holds, lift.holds) == (0.0, True, True)
    high = Pose(position_m=np.array([0.3, 0.2, 0.5]), quaternion_xyzw=np.array([1.0, 0, 0, 0]))
    assert len(route_to_grasp(grasp, high, [UprightBox.of(tall)])) == 3


def test_objects_that_moved_or_are_hidden_afterwards_are_told() -> None:
    red, green, blue = cube(), cube("green", y_m=0.1), cube("blue", y_m=-0.1)
    lifted = cube(bottom_m=0.12)
    pushed = cube("green", y_m=0.11)
    told = displaced(look(red, green, blue), look(lifted, pushed), red)
    (moved,) = told.others_moved
    assert (moved.object, round(moved.by_m, 3)) == ("green cube", 0.01)
    assert told.not_seen_after == ["blue cube"]
    still = displaced(look(red, green), look(lifted, cube("green", y_m=0.101)), red)
    assert not any(still.model_dump().values())


@pytest.mark.parametrize(
    "change", [{"uncertainty_m": 0.066, "is_whole": False}, {"is_whole": False}, {}]
)
@pytest.mark.parametrize("is_before", [True, False])
def test_what_is_not_seen_well_is_not_told_as_moved(
    change: dict[str, Any], is_before: bool
) -> None:
    red, green = cube(), cube("green", y_m=0.1)
    vague = replace(green, position_m=green.position_m + np.array([0.0, 0.08, 0.0]), **change)
    looks = look(red, green), look(cube(bottom_m=0.12), vague)
    if not change:  # as it was seen before it was hidden
        looks = looks[0], replace(looks[1], hidden=frozenset([vague]))
    if is_before:
        looks = replace(looks[0], objects=(red, vague), hidden=looks[1].hidden), look(green)
    told = displaced(*looks, red)
    assert (told.others_moved, told.not_seen_well) == (None, ["green cube"])


def test_a_shift_within_both_uncertainties_is_no_motion() -> None:
    green = replace(cube("green"), uncertainty_m=0.0027)
    seen = replace(green, position_m=green.position_m + np.array([0.005, 0.0, 0.0]))
    told = displaced(look(green), look(seen), None)
    assert (told.others_moved, told.not_seen_well) == (None, ["green cube"])


class OneLook:
    table_m = 0.0

    def __init__(self, *objects: LocatedObject) -> None:
        self._look = look(*objects)

    def look(self, who: str, newer_than_ns: int = 0) -> CellLook:
        return self._look

    def last_look(self, who: str) -> CellLook | None:
        return self._look

    def forget(self, one: LocatedObject) -> None:
        raise AssertionError("nothing is moved here")


def test_a_position_means_the_only_object_near_it() -> None:
    looker = OneLook(cube(), cube("green", y_m=0.2))
    _, one = target_of(PickArguments(position_m=[0.5, 0.21, 0.02]), looker, "agent")
    assert one.colour == "green"
    for arguments in (
        PickArguments(position_m=[0.5, 0.1, 0.02]),
        PickArguments(position_m=[0.5, 0.2, 0.02], mark=1),
    ):
        with pytest.raises(InvalidInputError):
            target_of(arguments, looker, "agent")

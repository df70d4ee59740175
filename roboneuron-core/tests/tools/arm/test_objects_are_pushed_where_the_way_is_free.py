"""Plans of push: strokes across the faces that add up to the shift, from behind and at the middle,
and nothing where the object or the hand would touch another.
"""

from __future__ import annotations

import numpy as np
import pytest

from roboneuron import LocatedObject, Pose, RefusedError
from roboneuron.tools.arm.hand_space import UprightBox
from roboneuron.tools.arm.options import HandOptions
from roboneuron.tools.arm.pushing import route_of_push, strokes_of
from roboneuron.tools.arm.routes import Waypoint

HAND = HandOptions()
EDGE_M = 0.044
START = Pose(position_m=np.array([0.3, 0.0, 0.5]), quaternion_xyzw=np.array([1.0, 0, 0, 0]))


def cube(
    x_m: float, y_m: float = 0.0, yaw_rad: float | None = 0.0, bottom_m: float = 0.0
) -> LocatedObject:
    return LocatedObject(
        label="cube",
        colour="red",
        position_m=np.array([x_m, y_m, bottom_m + EDGE_M / 2]),
        yaw_rad=yaw_rad,
        symmetry_rad=np.pi / 2,
        size_m=np.full(3, EDGE_M),
        uncertainty_m=0.001,
        cameras=("above",),
        seen_at_ns=1,
    )


def route(one: LocatedObject, shift: tuple[float, float], *others: LocatedObject) -> list[Waypoint]:
    boxes = [UprightBox.of(other) for other in others]
    return route_of_push(one, np.array(shift), boxes, START, HAND)


def place(part: Waypoint) -> np.ndarray:
    assert part.position_m is not None
    return part.position_m


@pytest.mark.parametrize("yaw_rad", [0.0, 0.4, -0.7, None])
def test_strokes_add_up_to_the_shift(yaw_rad: float | None) -> None:
    random = np.random.default_rng(5)
    for _ in range(50):
        shift = random.uniform(-0.1, 0.1, 2)
        strokes = list(strokes_of(cube(0.5, yaw_rad=yaw_rad), shift))
        total = sum((length * direction for direction, length in strokes), np.zeros(2))
        assert np.linalg.norm(total - shift) < 0.003 * np.sqrt(2)
        lengths = [length for _, length in strokes]
        assert lengths == sorted(lengths, reverse=True)


def test_it_is_pushed_from_behind_at_its_middle_with_closed_fingers() -> None:
    closed, above, down, along, back, up = route(cube(0.5), (0.06, 0.0))
    assert closed.opening == 0.0
    contact_m = EDGE_M / 2 + HAND.finger_width_m / 2
    assert place(down) == pytest.approx([0.5 - contact_m - 0.02, 0.0, EDGE_M / 2])
    assert place(along) == pytest.approx([0.56 - contact_m, 0.0, EDGE_M / 2])
    assert place(back)[0] < place(along)[0]
    for part in (above, up):
        assert place(part)[2] > EDGE_M + HAND.tip_m
    assert along.speed < above.speed


@pytest.mark.parametrize(
    ("other", "rule"),
    [
        (cube(0.59), "in_the_way"),  # before the object
        (cube(0.42), "in_the_way"),  # where the hand would come down
        (cube(0.5, 0.0, 0.0, EDGE_M), "covered"),
        (cube(0.5, 0.1), ""),
        (cube(0.7), ""),
    ],
)
def test_what_stands_in_the_way_is_named(other: LocatedObject, rule: str) -> None:
    if not rule:
        assert route(cube(0.5), (0.06, 0.0), other)
        return
    with pytest.raises(RefusedError) as refusal:
        route(cube(0.5), (0.06, 0.0), other)
    assert refusal.value.rule == rule

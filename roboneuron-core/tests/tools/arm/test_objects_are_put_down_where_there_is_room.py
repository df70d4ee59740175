"""Plans of place: at a position, on an object, beside one; the height comes from what is below, and
what has no room or no support is refused with its rule.
"""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
import pytest

from roboneuron import LocatedObject, NotReadyError, Pose, RefusedError
from roboneuron.contract import F64
from roboneuron.tools.arm.absolute import top_down
from roboneuron.tools.arm.hand_space import UprightBox, gap_m
from roboneuron.tools.arm.options import HandOptions
from roboneuron.tools.arm.put_down import (
    Descent,
    HeldObject,
    PlaceTarget,
    Side,
    beside,
    descents_of,
    route_down,
)
from roboneuron.tools.arm.routes import run_route

HAND = HandOptions()
EDGE_M = 0.044


def cube(
    colour: str, x_m: float, y_m: float = 0.0, yaw_rad: float | None = 0.0, bottom_m: float = 0.0
) -> LocatedObject:
    return LocatedObject(
        label="cube",
        colour=colour,
        position_m=np.array([x_m, y_m, bottom_m + EDGE_M / 2]),
        yaw_rad=yaw_rad,
        symmetry_rad=np.pi / 2,
        size_m=np.full(3, EDGE_M),
        uncertainty_m=0.002,
        cameras=("above",),
        seen_at_ns=1,
    )


HELD = HeldObject.seen(cube("red", 0.4), np.array([0.4, 0.0, EDGE_M / 2]), 0.0)


def descents(target: PlaceTarget, *others: LocatedObject, held: HeldObject = HELD) -> list[Descent]:
    return descents_of(target, held, others, 0.0, 0.0, HAND, EDGE_M)


def test_on_a_free_table_it_is_let_go_just_above_it() -> None:
    (first,) = descents(PlaceTarget(middle=np.array([0.5, 0.1])))
    assert first.position_m == pytest.approx([0.5, 0.1, EDGE_M / 2 + 0.002])
    assert first.object_m == pytest.approx([0.5, 0.1, EDGE_M / 2])
    assert first.opening == 1.0


def test_on_an_object_it_is_let_go_on_its_top_with_its_yaw() -> None:
    blue = cube("blue", 0.5, yaw_rad=0.4)
    found = descents(PlaceTarget(middle=blue.position_m[:2], yaw_rad=0.4, on=blue), blue)
    assert len(found) == 4, "a cube looks the same after each quarter turn"
    assert found[0].yaw_rad == pytest.approx(0.4)
    assert found[0].position_m[2] == pytest.approx(1.5 * EDGE_M + 0.002)


def test_an_object_that_lies_off_the_middle_of_the_hand_comes_to_the_middle_of_its_place() -> None:
    held = HeldObject.seen(cube("red", 0.41, 0.005), np.array([0.4, 0.0, 0.03]), 0.0)
    target = PlaceTarget(middle=np.array([0.5, 0.1]), yaw_rad=np.pi / 2, is_hand_yaw=True)
    (first,) = descents(target, held=held)
    # the hand has turned by a quarter, and the offset with it
    assert first.position_m[:2] == pytest.approx([0.5 + 0.005, 0.1 - 0.01])
    assert first.position_m[2] == pytest.approx(0.03 + 0.002)


@pytest.mark.parametrize("side", ["+x", "-x", "+y", "-y"])
@pytest.mark.parametrize("yaw_rad", [0.0, 0.3, -0.7, None])
def test_beside_means_parallel_with_that_gap_on_that_side(
    side: Side, yaw_rad: float | None
) -> None:
    blue = cube("blue", 0.5, yaw_rad=yaw_rad)
    target = beside(blue, HELD, side, 0.05, 0.0)
    axis, sign = "xy".index(side[1]), 1 if side[0] == "+" else -1
    assert sign * (target.middle[axis] - blue.position_m[axis]) > 0.06
    (first, *_) = descents(target, blue)
    put = HELD.box(target.middle, first.yaw_rad, 0.0)
    if yaw_rad is not None:
        assert gap_m(put, UprightBox.of(blue)) == pytest.approx(0.05, abs=1e-6)
    else:
        assert gap_m(put, UprightBox.of(blue)) >= 0.05 - 1e-6


def test_between_two_it_is_let_go_with_the_fingers_along_the_gap() -> None:
    one, other = cube("blue", 0.5, 0.06), cube("green", 0.5, -0.06)
    target = PlaceTarget(middle=np.array([0.5, 0.0]), yaw_rad=0.0)
    found = descents(target, one, other)
    assert {abs(round(np.cos(descent.yaw_rad), 6)) for descent in found} == {0.0}


BLUE, ON_BLUE = cube("blue", 0.5), cube("green", 0.5, bottom_m=EDGE_M)


@pytest.mark.parametrize(
    ("target", "others", "rule"),
    [
        (PlaceTarget(middle=np.array([0.51, 0.0])), (BLUE,), "occupied"),
        (PlaceTarget(middle=BLUE.position_m[:2], on=BLUE), (BLUE, ON_BLUE), "occupied"),
        (PlaceTarget(middle=np.array([0.53, 0.0]), on=BLUE), (BLUE,), "unstable"),
        (PlaceTarget(middle=np.array([0.5, EDGE_M + 0.001])), (BLUE,), "too_close"),
        (
            PlaceTarget(middle=np.array([0.5, 0.0]), yaw_rad=0.0),
            tuple(
                cube(name, 0.5 + x, y)
                for name, x, y in (
                    ("blue", 0.056, 0),
                    ("green", -0.056, 0),
                    ("yellow", 0, 0.056),
                    ("purple", 0, -0.056),
                )
            ),
            "too_close",
        ),
    ],
)
def test_what_has_no_room_or_no_support_is_refused(
    target: PlaceTarget, others: Any, rule: str
) -> None:
    with pytest.raises(RefusedError) as refusal:
        descents(target, *others)
    assert refusal.value.rule == rule


def test_it_is_carried_over_everything_and_left_upwards() -> None:
    tall = [cube("blue", 0.5, 0.3), cube("green", 0.5, 0.3, bottom_m=EDGE_M)]
    (first,) = descents(PlaceTarget(middle=np.array([0.5, 0.0])), *tall)
    start = Pose(position_m=np.array([0.4, 0.0, 0.03]), quaternion_xyzw=np.array([1.0, 0, 0, 0]))
    up, above, down, away = route_down(first, HELD, start, tall, 0.0)
    for part in (up, above):
        assert part.position_m is not None
        assert part.position_m[2] - HELD.below_m > 2 * EDGE_M
        assert part.holds
    assert down.opening == first.opening
    assert away.position_m is not None
    assert down.position_m is not None
    assert away.position_m[2] > down.position_m[2] + 0.03


class StuckCarrier:
    """Carries out parts of a route until the hand has opened or closed `openings` times; no later
    move arrives.
    """

    def __init__(self, openings: int) -> None:
        self._left = openings
        self._place: F64 = np.array([0.4, 0.0, 0.2])

    async def pose(self) -> tuple[F64, F64]:
        return self._place, top_down(0.0)

    async def move(self, fields: dict[str, float]) -> None:
        if self._left <= 0:
            raise NotReadyError("The arm is stuck.")
        if "gripper_open" in fields:
            self._left -= 1
        self._place = self._place + [fields.get(axis, 0.0) for axis in ("dx_m", "dy_m", "dz_m")]

    def check_holds(self) -> None:
        pass


@pytest.mark.parametrize("openings", [0, 1])
def test_an_error_of_the_retreat_says_that_it_is_put_down(openings: int) -> None:
    (descent,) = descents(PlaceTarget(middle=np.array([0.5, 0.1])))
    start = Pose(
        position_m=np.array([0.4, 0.0, 0.2]),
        quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0]),
        stamp_ns=1,
    )
    route = route_down(descent, HELD, start, (), 0.0)
    with pytest.raises(NotReadyError) as failed:
        asyncio.run(run_route(StuckCarrier(openings), route, 1.0, (1.0, 1.0)))
    assert ('"red cube" is put down' in failed.value.hint) is bool(openings)

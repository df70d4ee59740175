"""look and locate with depth that is published, with a locator that needs it, and with one that is
slow.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from painted_cell import PaintedCell, WaitingLocator, depth_message, message

from roboneuron import LocatedObject, LocatorSpec
from roboneuron.sight.plugin import LOCATORS

CUBES = {"red": (0.5, 0.1, 0.3), "green": (0.42, -0.1, -0.2), "blue": (0.6, 0.0, 0.6)}


def look(cell: PaintedCell) -> Any:
    return cell.call(cell.sight()[1]["look"])


def painted_depth_m() -> np.ndarray:
    """Of the camera above: the table, 0.8 m below it, and a hole."""
    depth_m = np.full((224, 224), 0.8, dtype=np.float32)
    depth_m[:20] = np.nan
    return depth_m


@pytest.mark.parametrize(
    ("row", "surface", "height_m"), [(200, "depth", 0.1), (10, "table", 0.0)], ids=["seen", "hole"]
)
def test_depth_that_is_published_tells_the_place_of_a_pixel(
    row: int, surface: str, height_m: float
) -> None:
    depth_m = painted_depth_m() - np.float32(0.1)
    cell = PaintedCell(depths={"above": depth_message(depth_m)})
    place = cell.call(cell.sight()[1]["locate"], camera="above", pixel=[20, row])
    assert place.surface == surface
    assert place.position_m[2] == pytest.approx(height_m, abs=1e-3)


@pytest.mark.parametrize(
    "bad",
    [
        depth_message(painted_depth_m(), age_s=0.3),
        depth_message(painted_depth_m()[:100]),
        SimpleNamespace(**{**vars(message(np.zeros((224, 224, 3), np.uint8))), "header": None}),
    ],
    ids=["of another time", "of another size", "no depth"],
)
def test_depth_that_does_not_belong_to_the_picture_is_not_used(bad: Any) -> None:
    cell = PaintedCell(cubes=CUBES, depths={"above": bad})
    answer = look(cell).result
    assert len(answer.objects) == 3
    assert answer.problems == {}
    place = cell.call(cell.sight()[1]["locate"], camera="above", pixel=[20, 200])
    assert place.surface == "table"


def test_a_locator_that_needs_depth_says_that_there_is_none() -> None:
    cell = PaintedCell(cubes=CUBES, locator=replace(LOCATORS[0], needs_depth=True))
    answer = look(cell).result
    assert answer.objects == []
    assert "needs depth" in answer.problems["locator"]


FORGOTTEN = LocatedObject(
    label="cube",
    position_m=np.array([0.3, 0.0, 0.02]),
    size_m=np.full(3, 0.04),
    uncertainty_m=0.002,
    cameras=("above",),
    seen_at_ns=1,
)


def test_a_slow_locator_delays_neither_what_is_forgotten_nor_the_end() -> None:
    waiting = LocatorSpec(name="w", summary="Waits.", target="painted_cell:WaitingLocator")
    feature, _ = PaintedCell(cubes=CUBES, locator=waiting).sight()
    looking = threading.Thread(target=feature.look, args=("agent",))
    looking.start()
    try:
        assert WaitingLocator.entered.wait(10.0)
        began_s = time.monotonic()
        feature.forget(FORGOTTEN)
        assert feature.last_look("agent") is None
        assert time.monotonic() - began_s < 0.5
        feature.close()
        assert time.monotonic() - began_s < 3.0
    finally:
        WaitingLocator.free.set()
        looking.join(10.0)
    assert not looking.is_alive()

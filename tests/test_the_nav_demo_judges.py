"""`make demo-nav` succeeds only if the simulators agree and the zone was refused."""

from __future__ import annotations

import importlib
import math
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import anyio
import pytest
from rich.console import Console

from rn_simulation.planar_motion import PlanarPose
from roboneuron import NotReadyError

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def demo(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The example as a module."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module("demo_nav")


@pytest.mark.parametrize(
    ("x_m", "y_m", "yaw_rad", "expected"),
    [
        (1.2, 0.5, math.pi / 2, True),
        (1.27, 0.5, math.pi / 2 - 0.1, True),
        (1.2, 0.5, math.pi / 2 - 2 * math.pi, True),
        (1.31, 0.5, math.pi / 2, False),
        (1.2, 0.5, 0.0, False),
        (0.0, 0.0, 0.0, False),
    ],
)
def test_a_base_is_at_the_table_by_place_and_heading(
    demo: ModuleType, x_m: float, y_m: float, yaw_rad: float, expected: bool
) -> None:
    assert demo.is_at_table(PlanarPose(x_m=x_m, y_m=y_m, yaw_rad=yaw_rad)) is expected


def test_a_base_that_tells_nothing_is_not_at_the_table(demo: ModuleType) -> None:
    assert not demo.is_at_table(None)


@pytest.mark.parametrize("missing", ["", "zone", "base", "arm"])
def test_every_judge_has_to_say_yes(demo: ModuleType, missing: str) -> None:
    made: Any = demo.Demo(None, None, "red")
    made.is_zone_refused = missing != "zone"
    made.base = demo.TABLE if missing != "base" else PlanarPose()
    made.arm.is_done = missing != "arm"
    assert made.print_verdicts(Console(quiet=True)) is (missing == "")


def test_a_zone_that_is_refused_for_another_reason_does_not_count(demo: ModuleType) -> None:
    class Refuses:
        async def call(self, tool: str, arguments: object) -> dict[str, object]:
            raise NotReadyError("send_drive_to_goal: nobody serves it.")

    made: Any = demo.Demo(Refuses(), None, "red")
    assert "nobody serves it" in anyio.run(made.ask_for_the_zone)
    assert not made.is_zone_refused


def test_the_zone_that_is_asked_for_is_one_of_the_configuration(demo: ModuleType) -> None:
    text = (EXAMPLES / "demo_nav.toml").read_text(encoding="utf-8")
    entry = tomllib.loads(text)["robots"]["base"]["expose"][0]
    (zone,) = entry["zones"]
    x_m, y_m = demo.STAIRS_M
    assert zone["lower_m"][0] <= x_m <= zone["upper_m"][0]
    assert zone["lower_m"][1] <= y_m <= zone["upper_m"][1]

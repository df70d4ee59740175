"""`make demo-fleet` succeeds only if each simulator agrees; its film is complete."""

from __future__ import annotations

import importlib
import json
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from PIL import Image

from rn_simulation.planar_motion import PlanarPose
from roboneuron.config import load_config

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def demo(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The example as a module."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module("demo_fleet")


def arm_status(lifted_m: float, held_s: float) -> dict[str, Any]:
    cubes = {
        "red": {"lifted_m": lifted_m, "held_s": held_s},
        "blue": {"lifted_m": 0.3, "held_s": 9.0},
    }
    return {"modules": [{"module": "robot", "detail": {"cubes": json.dumps(cubes)}}]}


@pytest.mark.parametrize(
    ("lifted_m", "held_s", "told", "expected"),
    [
        (0.15, 1.2, "succeeded, attempt 1", True),
        (0.15, 0.4, "succeeded, attempt 1", False),
        (0.00, 0.0, "succeeded, attempt 1", False),
        (0.15, 1.2, "unclear, attempt 1", False),
        (0.15, 1.2, "failed", False),
    ],
)
def test_an_arm_is_done_when_its_own_cube_was_held(
    demo: ModuleType, lifted_m: float, held_s: float, told: str, expected: bool
) -> None:
    work = demo.Work(robot="left", task="", told=told, status=arm_status(lifted_m, held_s))
    demo.judge_arm(work, "red")
    assert work.is_done is expected


def test_an_arm_without_an_answer_is_not_done(demo: ModuleType) -> None:
    work = demo.Work(robot="left", task="", told="succeeded, attempt 1", is_done=True)
    demo.judge_arm(work, "red")
    assert not work.is_done


def test_a_base_is_done_when_it_has_driven_its_path(demo: ModuleType) -> None:
    planned = demo.PLANNED
    at_rest = [PlanarPose()] * 50
    half = planned[: len(planned) // 2]
    aside = [PlanarPose(x_m=p.x_m + 0.3, y_m=p.y_m, yaw_rad=p.yaw_rad) for p in planned]
    turned = [
        *planned,
        PlanarPose(x_m=planned[-1].x_m, y_m=planned[-1].y_m, yaw_rad=planned[-1].yaw_rad + 1.0),
    ]
    for track, told, expected in (
        (planned, "done", True),
        (planned, "failed", False),
        (at_rest, "done", False),
        (half, "done", False),
        (aside, "done", False),
        (turned, "done", False),
        ([], "done", False),
    ):
        work = demo.Work(robot="base", task="", told=told)
        demo.judge_base(work, track)
        assert work.is_done is expected, work.truth


def test_robots_that_work_one_after_the_other_are_not_at_work_at_once(demo: ModuleType) -> None:
    works = [
        demo.Work(robot=str(n), task="", begun_s=a, ended_s=b)
        for n, (a, b) in enumerate([(0, 5), (6, 9)])
    ]
    assert demo.together_s(works) == -1
    assert demo.together_s([demo.Work(robot="", task="")]) == -math.inf


def test_the_configuration_has_a_scene_for_each_arm(demo: ModuleType, tmp_path: Path) -> None:
    config = load_config(demo.write_configuration(tmp_path, 7))
    assert [config.robots[name].plugins["fr3"]["seed"] for name in ("left", "right")] == [7, 8]
    assert list(config.robots) == ["left", "right", "base"]


def test_the_film_shows_all_robots_also_when_an_image_was_late(
    demo: ModuleType, tmp_path: Path
) -> None:
    film = demo.FleetFilm()
    red = Image.new("RGB", (64, 64), "red")
    names = ("left", "right", "base")
    film.add(
        0.0,
        {"left": red, "right": None, "base": demo.draw_from_above(demo.PLANNED, [])},
        {n: n for n in names},
    )
    film.add(
        0.5,
        {"left": None, "right": red, "base": demo.draw_from_above(demo.PLANNED, demo.PLANNED)},
        {},
    )
    strip, gif = film.save(tmp_path)
    with Image.open(gif) as made:
        assert made.n_frames == 2
        assert made.width > 3 * 300
    with Image.open(strip) as made:
        assert made.height > made.width

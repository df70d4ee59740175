"""Demonstrations and training print rate, remaining time and metrics from the first seconds on."""

from __future__ import annotations

import re
import resource
from pathlib import Path

import numpy as np
import pytest
import torch

from rn_policy_cubes.curve import CURVE_FILE
from rn_policy_cubes.learner import STATE_FILE, Schedule
from rn_policy_cubes.progress import Progress, duration
from rn_policy_cubes.recipe import Recipe
from rn_policy_cubes.record import record
from rn_policy_cubes.replacing import replacing
from rn_policy_cubes.training import train
from roboneuron import StateError


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_a_line_has_rate_and_time_left_of_this_start() -> None:
    clock, said = Clock(), list[str]()
    progress = Progress("step", 1000, 400, said.append, every_s=10.0, clock=clock)
    clock.now_s += 5.0
    assert not progress.update(420)
    clock.now_s += 5.0
    assert progress.update(450, "total 1.2")
    clock.now_s += 1.0
    assert not progress.update(460)
    assert progress.update(1000)
    assert said == [
        "step 450/1000 (45 %), 5.0 a second, 2 min left; total 1.2",
        "step 1000/1000 (100 %), 54.5 a second, 0 s left",
    ]


def test_slow_work_is_told_by_the_minute() -> None:
    clock, said = Clock(), list[str]()
    progress = Progress("shards", 10, 0, said.append, every_s=10.0, clock=clock)
    clock.now_s += 20.0
    progress.update(0)
    clock.now_s += 40.0
    progress.update(2)
    assert said == [
        "shards 0/10 (0 %), 20 s so far",
        "shards 2/10 (20 %), 2.0 a minute, 4 min left",
    ]


@pytest.mark.parametrize(("seconds", "text"), [(40, "40 s"), (720, "12 min"), (11100, "3 h 5 min")])
def test_times_are_short(seconds: float, text: str) -> None:
    assert duration(seconds) == text


@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.exhaustive), 2])
def test_demonstrations_are_counted(tmp_path: Path, workers: int) -> None:
    said: list[str] = []
    record(tmp_path, 2, workers=workers, say=said.append, views=12)
    assert said[0].startswith("demonstrations: 0 of 2 shards exist")
    assert re.match(
        r"demonstrations: views 24/24 \(100 %\), [\d.]+ a (second|minute), 0 s left", said[-1]
    )
    again: list[str] = []
    record(tmp_path, 2, workers=workers, say=again.append, views=12)
    assert again == []


@pytest.mark.exhaustive
def test_training_tells_losses_and_a_preview_and_is_not_changed_by_it(
    recipe: Recipe, shards: Path, tmp_path: Path
) -> None:
    said: list[str] = []
    whole = recipe.model_copy(update={"steps": 3})
    always = Schedule(say_every_s=0.0, preview_every_s=0.0)
    train(whole, tmp_path / "told", shards, say=said.append, schedule=always)
    assert said[0] == "training: reading 2 shards of demonstrations"
    assert "million parameters on" in said[1]
    assert re.match(
        r"step 1/3 \(33 %\), [\d.]+ a (second|minute), \d+ s left; total [\d.]+, action", said[2]
    )
    assert re.match(
        r"  preview at step 1, of 24 held-out views: place nearest to the named cube \d+ %", said[3]
    )
    assert "  held out at step 3: " in said[-1]
    train(whole, tmp_path / "quiet", shards, say=lambda line: None)
    told, quiet = (
        torch.load(tmp_path / name / STATE_FILE, weights_only=True)["network"]
        for name in ("told", "quiet")
    )
    assert all(torch.equal(told[key], quiet[key]) for key in told)
    assert len((tmp_path / "told" / CURVE_FILE).read_text().splitlines()) == 2


def save(kind: str, path: Path) -> None:
    with replacing(path) as unfinished, unfinished.open("wb") as file:
        if kind == "torch":
            torch.save(torch.zeros(10_000), file)
        else:
            np.save(file, np.zeros(10_000))


@pytest.mark.parametrize("kind", ["torch", "numpy"])
def test_a_full_disk_is_told_with_the_file_and_keeps_what_was_there(
    tmp_path: Path, kind: str
) -> None:
    path = tmp_path / "state.bin"
    path.write_bytes(b"before")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))  # like a full disk
    try:
        with pytest.raises(StateError, match=r"state\.bin cannot be written"):
            save(kind, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == b"before"
    assert [found.name for found in tmp_path.iterdir()] == ["state.bin"]

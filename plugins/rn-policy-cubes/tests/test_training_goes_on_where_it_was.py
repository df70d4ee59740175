"""An interrupted training ends with the same result, bit for bit."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from rn_policy_cubes.curve import CURVE_FILE
from rn_policy_cubes.learner import STATE_FILE, Schedule
from rn_policy_cubes.measure import turn_error
from rn_policy_cubes.recipe import Recipe
from rn_policy_cubes.training import Training, pack, train
from roboneuron import ConfigurationError


def quiet(line: str) -> None:
    """Print nothing."""


def run(recipe: Recipe, directory: Path, shards: Path, until: int | None = None) -> Training:
    schedule = Schedule(log_every=2, measure_every=4)
    return train(recipe, directory, shards, until=until, say=quiet, schedule=schedule)


@pytest.mark.exhaustive
def test_resuming_equals_an_uninterrupted_run(recipe: Recipe, shards: Path, tmp_path: Path) -> None:
    run(recipe, tmp_path / "whole", shards)
    for until in (1, 3, 5, None):
        run(recipe, tmp_path / "parts", shards, until)
    whole, parts = (
        torch.load(tmp_path / name / STATE_FILE, weights_only=True) for name in ("whole", "parts")
    )
    assert whole["step"] == parts["step"] == recipe.steps
    for name in ("network", "helpers", "average", "average_helpers"):
        for key, value in whole[name].items():
            assert torch.equal(value, parts[name][key]), f"{name} {key}"


def test_the_curve_and_the_packed_card_tell_how_far_it_came(
    recipe: Recipe, shards: Path, tmp_path: Path
) -> None:
    run(recipe, tmp_path, shards)
    card = pack(tmp_path).card
    assert card.step == recipe.steps
    assert card.recipe == recipe
    assert "held_out_place_mm" in card.figures
    lines = [json.loads(line) for line in (tmp_path / CURVE_FILE).read_text().splitlines()]
    losses = [line for line in lines if "total" in line]
    figures = [line for line in lines if "held_out_named_nearest" in line]
    assert [line["step"] for line in losses] == [2, 4, 6]
    assert [line["step"] for line in figures] == [4, 6]
    assert 0 <= figures[-1]["held_out_named_nearest"] <= 1
    assert figures[-1]["held_out_action_mm"] > 0
    assert 0 <= figures[-1]["held_out_turn_rad"] <= math.pi / 4


@pytest.mark.exhaustive
def test_losses_fall(recipe: Recipe, shards: Path, tmp_path: Path) -> None:
    longer = recipe.model_copy(update={"steps": 40, "full_from": 1.0, "cool_down": 0.0, "views": 8})
    train(longer, tmp_path, shards, say=quiet, schedule=Schedule(log_every=10))
    totals = [
        line["total"]
        for line in map(json.loads, (tmp_path / CURVE_FILE).read_text().splitlines())
        if "total" in line
    ]
    assert totals[-1] < 0.9 * totals[0]


def test_an_error_of_a_turn_is_never_more_than_an_eighth() -> None:
    turns = torch.tensor([0.1, 0.75, -0.75, 0.0])
    told = turns + torch.tensor([0.05, 0.1, 0.0, torch.pi / 4])

    def angles(values: torch.Tensor) -> torch.Tensor:
        return torch.stack(((4 * values).sin(), (4 * values).cos()), dim=1)

    assert turn_error(angles(told), angles(turns)) == pytest.approx(
        [0.05, 0.1, 0.0, torch.pi / 4], abs=1e-5
    )


def test_the_rate_rises_stays_and_falls(recipe: Recipe, shards: Path, tmp_path: Path) -> None:
    training = run(
        recipe.model_copy(update={"steps": 100, "warm_up": 10, "cool_down": 0.2}),
        tmp_path,
        shards,
        until=0,
    )
    rates = []
    for step in (0, 9, 50, 90, 100):
        training.step = step
        rates.append(training.rate() / recipe.rate)
    assert rates == pytest.approx([0.1, 1.0, 1.0, 0.5, 0.0])


def test_packing_needs_a_training(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="holds no training"):
        pack(tmp_path)

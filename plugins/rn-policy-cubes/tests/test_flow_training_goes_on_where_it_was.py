"""The flow policy's training: resumable, and it learns."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from rn_policy_cubes.command import CubesPolicy
from rn_policy_cubes.curve import CURVE_FILE
from rn_policy_cubes.dataset import Shards, every
from rn_policy_cubes.flow.losses import FlowTask, from_network, to_network
from rn_policy_cubes.flow.packing import pack_flow
from rn_policy_cubes.flow.recipe import ACTION_STD, FLOW_ROWS, FlowRecipe, FlowShape
from rn_policy_cubes.flow.training import FlowTraining, train_flow
from rn_policy_cubes.flow.words import read_flow_prompts, write_flow_tokenizer
from rn_policy_cubes.learner import STATE_FILE, Schedule
from rn_policy_cubes.recipe import ACTION_SCALE
from roboneuron import ConfigurationError

RECIPE = FlowRecipe(
    shape=FlowShape(
        vision_width=16,
        vision_heads=2,
        vision_inner=24,
        hidden=24,
        intermediate=32,
        expert=16,
        expert_intermediate=24,
        layers=3,
        heads=2,
        head_width=8,
    ),
    shards=2,
    steps=6,
    views=3,
    samples=2,
    tokens=20,
    full_from=0.6,
    full_views=2,
    warm_up=2,
)


def quiet(line: str) -> None:
    """Print nothing."""


def run(directory: Path, shards: Path, until: int | None = None) -> FlowTraining:
    schedule = Schedule(log_every=2, measure_every=4)
    return train_flow(RECIPE, directory, shards, until=until, say=quiet, schedule=schedule)


# takes many seconds; test_training_goes_on_where_it_was.py shows the same of the other policy
@pytest.mark.exhaustive
def test_resuming_equals_an_uninterrupted_run(shards: Path, tmp_path: Path) -> None:
    run(tmp_path / "whole", shards)
    for until in (1, 4, None):
        run(tmp_path / "parts", shards, until)
    whole, parts = (
        torch.load(tmp_path / name / STATE_FILE, weights_only=True) for name in ("whole", "parts")
    )
    assert whole["step"] == parts["step"] == RECIPE.steps
    for name in ("network", "helpers", "average", "average_helpers"):
        for key, value in whole[name].items():
            assert torch.equal(value, parts[name][key]), f"{name} {key}"


@pytest.mark.exhaustive
def test_losses_fall_and_the_curve_tells_them(shards: Path, tmp_path: Path) -> None:
    longer = RECIPE.model_copy(
        update={"steps": 60, "full_from": 1.0, "cool_down": 0.0, "views": 8, "samples": 4}
    )
    train_flow(longer, tmp_path, shards, say=quiet, schedule=Schedule(log_every=10))
    lines = [json.loads(line) for line in (tmp_path / CURVE_FILE).read_text().splitlines()]
    flows = [line["flow"] for line in lines if "flow" in line]
    assert flows[-1] < 0.9 * flows[0]
    assert lines[-1]["held_out_action_mm"] > 0
    card = pack_flow(tmp_path).card
    assert card.step == 60
    assert "held_out_turn_rad" in card.figures


def test_the_flow_leads_from_noise_to_the_labelled_actions(shards: Path, tmp_path: Path) -> None:
    write_flow_tokenizer(tmp_path / "tokenizer.json")
    prompts = read_flow_prompts(tmp_path / "tokenizer.json")
    held = Shards.load(shards, [1], FLOW_ROWS)
    batch = every(held, prompts, views=2, most=2)[0]
    assert batch.actions.shape == (8, FLOW_ROWS, 7)
    task = FlowTask.draw(batch, samples=3, seed=5)
    times = task.times[:, :, None, None]
    velocity = task.noise - to_network(batch.actions)[:, None]
    arrived = from_network(task.noisy(batch) - times * velocity)
    wanted = batch.actions * torch.tensor([*ACTION_SCALE, 1.0])
    for sample in range(3):
        torch.testing.assert_close(arrived[:, sample], wanted, atol=1e-5, rtol=1e-4)
    assert np.all(np.array(ACTION_STD) > 0)


def test_times_are_distributed_as_in_openpi(shards: Path, tmp_path: Path) -> None:
    write_flow_tokenizer(tmp_path / "tokenizer.json")
    prompts = read_flow_prompts(tmp_path / "tokenizer.json")
    batch = every(Shards.load(shards, [1], FLOW_ROWS), prompts, views=8, most=8)[0]
    drawn = [FlowTask.draw(batch, samples=4, seed=seed).times for seed in range(100)]
    times = torch.cat(drawn).flatten()
    assert float(times.min()) >= 0.001
    assert float(times.max()) <= 1.0
    # Beta(1.5, 1): P(t < x) = x^1.5; 12,800 stratified times, so 0.01 is several deviations
    for edge in (0.25, 0.5, 0.75):
        assert float((times < edge).float().mean()) == pytest.approx(edge**1.5, abs=0.01)


def test_packing_needs_a_training(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="holds no training"):
        pack_flow(tmp_path)


@pytest.mark.exhaustive
def test_command_trains_packs_and_unpacks(
    shards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from argparse import ArgumentParser

    parser = ArgumentParser()
    command = CubesPolicy()
    command.configure(parser)

    def call(*words: object) -> int:
        return command.run(parser.parse_args(["flow", *map(str, words)]))

    settings = [
        f"shape={json.dumps(RECIPE.shape.model_dump())}",
        *("shards=2", "steps=2", "views=2", "tokens=20", "full_from=1", "warm_up=1"),
    ]
    options = [word for setting in settings for word in ("--set", setting)]
    assert call("train", "--out", tmp_path / "out", "--data", shards, *options) == 0
    assert call("pack", "--out", tmp_path / "out", "--to", tmp_path / "flow.safetensors") == 0
    assert call("unpack", tmp_path / "policy", "--weights", tmp_path / "flow.safetensors") == 0
    assert (tmp_path / "policy" / "roboneuron.toml").exists()
    assert "step 2 of 2" in capsys.readouterr().out
    with pytest.raises(ConfigurationError, match="steps"):
        call("train", "--out", tmp_path / "out", "--data", shards, "--set", "steps=none")

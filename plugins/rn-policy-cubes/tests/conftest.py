"""Small shards and a small recipe: everything is trained and measured in seconds."""

from __future__ import annotations

from pathlib import Path

import pytest

from rn_policy_cubes.demonstrations import write_shard
from rn_policy_cubes.network import CubesNetwork
from rn_policy_cubes.recipe import NetworkShape, Recipe
from rn_policy_cubes.words import Prompts, read_prompts, write_tokenizer

VIEWS = 24


@pytest.fixture(scope="session")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two shards of a few views."""
    directory = tmp_path_factory.mktemp("shards")
    for number in range(2):
        write_shard(directory, number, VIEWS)
    return directory


@pytest.fixture(scope="session")
def recipe() -> Recipe:
    """Six steps of a very small network; the last ones see all tokens."""
    shape = NetworkShape(vision_width=16, hidden=48, intermediate=32, layers=3, heads=3)
    return Recipe(
        shape=shape, shards=2, steps=6, views=3, tokens=20, full_from=0.6, full_views=2, warm_up=2
    )


@pytest.fixture(scope="session")
def prompts(tmp_path_factory: pytest.TempPathFactory) -> Prompts:
    """The sentences of the training as token ids."""
    path = tmp_path_factory.mktemp("words") / "tokenizer.json"
    write_tokenizer(path)
    return read_prompts(path)


@pytest.fixture
def network(recipe: Recipe, prompts: Prompts) -> CubesNetwork:
    """A random network."""
    import torch

    torch.manual_seed(0)
    network = CubesNetwork(recipe.shape, prompts.in_use).eval()
    for tower in network.towers:
        torch.nn.init.normal_(tower.pos_embed, std=0.3)
    return network

"""The training of the policy that answers like OpenVLA-OFT."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from torch import nn

from rn_policy_cubes.curve import CURVE_FILE, newest_figures
from rn_policy_cubes.dataset import Batch, Shards
from rn_policy_cubes.learner import STATE_FILE, USUAL, Learner, Schedule, half_precision, learn
from rn_policy_cubes.losses import Helpers, Losses, losses
from rn_policy_cubes.measure import Figures, measure
from rn_policy_cubes.network import CubesNetwork
from rn_policy_cubes.packing import Card, Packed, network_of
from rn_policy_cubes.progress import Say
from rn_policy_cubes.recipe import Recipe
from rn_policy_cubes.start import new_network
from rn_policy_cubes.words import Prompts, read_prompts, write_tokenizer
from roboneuron import ConfigurationError


@dataclass
class Training(Learner):
    """The state of a training of this policy."""

    TOLD: ClassVar[tuple[str, ...]] = ("total", "action", "place", "accuracy")

    recipe: Recipe
    network: CubesNetwork
    helpers: Helpers
    average: CubesNetwork
    average_helpers: Helpers

    @classmethod
    def begin(
        cls,
        recipe: Recipe,
        prompts: Prompts,
        shards: Shards | None,
        device: torch.device,
        weights: Packed | None = None,
    ) -> Training:
        """A new training, from `weights` if given; without shards and weights it is not
        initialised, for `read`.
        """
        if weights is not None:
            torch.manual_seed(recipe.seed)
            network = network_of(weights)
        elif shards is None:
            network = CubesNetwork(recipe.shape, prompts.in_use)
        else:
            network = new_network(recipe.shape, prompts.in_use, shards, recipe.seed)
        return cls.of(recipe, network.to(device), Helpers(recipe.shape).to(device))

    @classmethod
    def read(cls, path: Path, recipe: Recipe, prompts: Prompts, device: torch.device) -> Training:
        """Resume from a file of `write`; see `Learner.restore`."""
        training = cls.begin(recipe, prompts, None, device)
        training.restore(path)
        return training

    def guidance(self) -> float:
        """Weight of the auxiliary losses."""
        return min(1.0, self.step / self.recipe.warm_up) if self.recipe.continues else 1.0

    def losses_of(self, batch: Batch) -> Losses:
        with half_precision(batch.state.device):
            thought = self.network(batch.look, batch.state, batch.ids, torch.bfloat16)
        return losses(thought, self.helpers, batch, self.guidance())

    def measured(self, held_out: Shards, prompts: Prompts, most: int | None = None) -> Figures:
        return measure(self.average, self.average_helpers, held_out, prompts, self.device, most)

    def layers(self) -> Iterable[nn.Module]:
        return self.network.layers


def train(
    recipe: Recipe,
    directory: Path,
    data: Path,
    *,
    weights: Packed | None = None,
    more: Sequence[int] = (),
    corrections: Sequence[Shards] = (),
    until: int | None = None,
    say: Say = print,
    schedule: Schedule = USUAL,
    fuse: bool = False,
) -> Training:
    """Train until step `until` (default: the recipe's last), resuming a training in `directory`.

    Args:
        recipe: settings of the training.
        directory: folder of state, curve and tokenizer.
        data: folder of the shards.
        weights: initial weights, for a recipe with `continues`.
        more: numbers of shards for training, besides those of the recipe.
        corrections: further views for training.
        until: step to stop at, to continue later.
        say: called with lines for people: rate, remaining time, losses, metrics on held-out views.
        schedule: how often it writes and reports.
        fuse: compile the layers first (needs a C++ compiler); this halves the time on a CPU.
    """
    directory.mkdir(parents=True, exist_ok=True)
    tokenizer = directory / "tokenizer.json"
    write_tokenizer(tokenizer)
    prompts = read_prompts(tokenizer)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    seen = recipe.shards - recipe.held_out
    say(f"training: reading {recipe.shards + len(more)} shards of demonstrations")
    shards = Shards.joined([Shards.load(data, [*range(seen), *more]), *corrections])
    held_out = Shards.load(data, range(seen, recipe.shards))
    state = directory / STATE_FILE
    if state.exists():
        training = Training.read(state, recipe, prompts, device)
    else:
        training = Training.begin(recipe, prompts, shards, device, weights)
    learn(
        training,
        directory,
        shards,
        held_out,
        prompts,
        until=until,
        say=say,
        schedule=schedule,
        fuse=fuse,
    )
    return training


def pack(directory: Path) -> Packed:
    """The averaged weights of a training, with the newest metrics of its curve.

    Raises:
        ConfigurationError: there is no training in the folder.
    """
    state = directory / STATE_FILE
    if not state.exists():
        raise ConfigurationError(
            f"{directory} holds no training.", hint="Start one: roboneuron policy cubes train"
        )
    saved = torch.load(state, map_location="cpu", weights_only=True)
    recipe = Recipe.model_validate(saved["recipe"])
    prompts = read_prompts(directory / "tokenizer.json")
    training = Training.read(state, recipe, prompts, torch.device("cpu"))
    figures = newest_figures(directory / CURVE_FILE)
    return Packed.of(
        training.average,
        Card(recipe=recipe, step=training.step, cpu_s=training.cpu_s, figures=figures),
    )

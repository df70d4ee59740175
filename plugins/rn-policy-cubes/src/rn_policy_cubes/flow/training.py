"""The training of the flow policy."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import nn

from rn_policy_cubes.dataset import Batch, Shards
from rn_policy_cubes.flow.losses import FlowHelpers, FlowLosses, FlowTask, flow_losses
from rn_policy_cubes.flow.measure import FlowFigures, measure_flow
from rn_policy_cubes.flow.network import CubesFlowNetwork
from rn_policy_cubes.flow.recipe import FLOW_ROWS, FlowRecipe, FlowShape
from rn_policy_cubes.flow.words import read_flow_prompts, write_flow_tokenizer
from rn_policy_cubes.learner import STATE_FILE, USUAL, Learner, Schedule, half_precision, learn
from rn_policy_cubes.progress import Say
from rn_policy_cubes.start import (
    FILTER_SIZE,
    POSITION_SHARE,
    coloured_patches,
    position_functions,
)
from rn_policy_cubes.words import Prompts


@torch.no_grad()
def new_flow_network(
    shape: FlowShape, vocabulary: int, shards: Shards, seed: int
) -> CubesFlowNetwork:
    """A network whose patch filters are the principal components of patches with cubes; a quarter
    of its channels start as functions of the patch's position.
    """
    torch.manual_seed(seed)
    network = CubesFlowNetwork(shape, vocabulary)
    values = coloured_patches(shards, np.random.default_rng([seed, 1])) * 2 - 1
    centre = values.mean(dim=0)
    count = shape.vision_width // POSITION_SHARE
    _, strength, components = torch.linalg.svd(values - centre, full_matrices=False)
    filters = min(shape.vision_width - count, len(components))
    strongest = strength[:filters, None]
    scale = FILTER_SIZE * len(values) ** 0.5 / strongest.clamp(min=1e-3 * float(strength[0]))
    weight = components[:filters] * scale
    network.patch.weight.zero_()
    network.patch.bias.zero_()
    network.patch.weight[:filters] = weight
    network.patch.bias[:filters] = -weight @ centre
    network.pos_embed[:, shape.vision_width - count :] = position_functions(count)
    return network


@dataclass
class FlowTraining(Learner):
    """The state of a training of the flow policy."""

    TOLD: ClassVar[tuple[str, ...]] = ("total", "flow", "place", "accuracy")

    recipe: FlowRecipe
    network: CubesFlowNetwork
    helpers: FlowHelpers
    average: CubesFlowNetwork
    average_helpers: FlowHelpers

    @classmethod
    def begin(
        cls, recipe: FlowRecipe, vocabulary: int, shards: Shards | None, device: torch.device
    ) -> FlowTraining:
        """A new training; without shards it is not initialised, for `read`."""
        if shards is None:
            network = CubesFlowNetwork(recipe.shape, vocabulary)
        else:
            network = new_flow_network(recipe.shape, vocabulary, shards, recipe.seed)
        return cls.of(recipe, network.to(device), FlowHelpers(recipe.shape).to(device))

    @classmethod
    def read(
        cls, path: Path, recipe: FlowRecipe, vocabulary: int, device: torch.device
    ) -> FlowTraining:
        """Resume from a file of `write`; see `Learner.restore`."""
        training = cls.begin(recipe, vocabulary, None, device)
        training.restore(path)
        return training

    def more_state(self) -> dict[str, object]:
        return {"vocabulary": self.network.vocabulary}

    def losses_of(self, batch: Batch) -> FlowLosses:
        recipe = self.recipe
        task = FlowTask.draw(batch, recipe.samples, recipe.seed * 1_000_003 + self.step)
        noisy, times = task.noisy(batch), task.times
        with half_precision(batch.state.device):
            prefix = self.network.read(batch.look, batch.ids, torch.bfloat16)
            thought = self.network(prefix, batch.state, noisy, times, torch.bfloat16)
        return flow_losses(prefix, thought, self.helpers, batch, task)

    def measured(self, held_out: Shards, prompts: Prompts, most: int | None = None) -> FlowFigures:
        return measure_flow(
            self.average, self.average_helpers, held_out, prompts, self.device, most
        )

    def layers(self) -> Iterable[nn.Module]:
        return (*self.network.layers, *self.network.expert)


def train_flow(
    recipe: FlowRecipe,
    directory: Path,
    data: Path,
    *,
    more: Sequence[int] = (),
    until: int | None = None,
    say: Say = print,
    schedule: Schedule = USUAL,
    fuse: bool = False,
) -> FlowTraining:
    """Train until step `until` (default: the recipe's last), resuming a training in `directory`.

    Args:
        recipe: settings of the training.
        directory: folder of state, curve and tokenizer.
        data: folder of the shards.
        more: numbers of shards for training, besides those of the recipe.
        until: step to stop at, to continue later.
        say: called with lines for people.
        schedule: how often it writes and reports.
        fuse: compile the layers first (needs a C++ compiler); this halves the time on a CPU.
    """
    directory.mkdir(parents=True, exist_ok=True)
    tokenizer = directory / "tokenizer.json"
    vocabulary = write_flow_tokenizer(tokenizer)
    prompts = read_flow_prompts(tokenizer)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    seen = recipe.shards - recipe.held_out
    say(f"training: reading {recipe.shards + len(more)} shards of demonstrations")
    shards = Shards.load(data, [*range(seen), *more], FLOW_ROWS)
    held_out = Shards.load(data, range(seen, recipe.shards), FLOW_ROWS)
    state = directory / STATE_FILE
    if state.exists():
        training = FlowTraining.read(state, recipe, vocabulary, device)
    else:
        training = FlowTraining.begin(recipe, vocabulary, shards, device)
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

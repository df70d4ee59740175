"""The training loop of the flow policy: it may be interrupted any number of times, with the same
result.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from rn_policy_cubes.dataset import Batch, Shards, draw, sampling
from rn_policy_cubes.flow.losses import FlowHelpers, FlowTask, flow_losses
from rn_policy_cubes.flow.measure import measure_flow
from rn_policy_cubes.flow.network import CubesFlowNetwork
from rn_policy_cubes.flow.recipe import FLOW_ROWS, FlowRecipe
from rn_policy_cubes.flow.start import new_flow_network
from rn_policy_cubes.flow.words import read_flow_prompts, write_flow_tokenizer
from rn_policy_cubes.progress import EVERY_S, Progress, Say
from rn_policy_cubes.recipe import PATCHES
from rn_policy_cubes.replacing import replacing
from rn_policy_cubes.training import CURVE_FILE, STATE_FILE, Curve, half_precision
from rn_policy_cubes.words import Prompts

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_BETAS, _DECAY, _CLIP = (0.9, 0.98), 0.01, 1.0
_AVERAGE = 0.995
_PREVIEW_VIEWS = 32


@dataclass
class FlowTraining:
    """The complete state of a training.

    Attributes:
        recipe: its settings.
        network, helpers: the trained modules.
        average, average_helpers: moving averages of their weights; the former is exported.
        step: steps done.
        cpu_s: CPU time of all steps.
    """

    recipe: FlowRecipe
    network: CubesFlowNetwork
    helpers: FlowHelpers
    average: CubesFlowNetwork
    average_helpers: FlowHelpers
    optimiser: torch.optim.Optimizer
    step: int = 0
    cpu_s: float = 0.0

    @classmethod
    def begin(
        cls, recipe: FlowRecipe, vocabulary: int, shards: Shards | None, device: torch.device
    ) -> FlowTraining:
        """A new training; without shards it is not initialised, for `read`."""
        if shards is None:
            network = CubesFlowNetwork(recipe.shape, vocabulary)
        else:
            network = new_flow_network(recipe.shape, vocabulary, shards, recipe.seed)
        network, helpers = network.to(device), FlowHelpers(recipe.shape).to(device)
        parameters = [*network.parameters(), *helpers.parameters()]
        optimiser = torch.optim.AdamW(parameters, recipe.rate, betas=_BETAS, weight_decay=_DECAY)
        return cls(
            recipe, network, helpers, copy.deepcopy(network), copy.deepcopy(helpers), optimiser
        )

    @classmethod
    def read(
        cls, path: Path, recipe: FlowRecipe, vocabulary: int, device: torch.device
    ) -> FlowTraining:
        """Resume from a file of `write`. The recipe may have another length, but not another
        shape.
        """
        training = cls.begin(recipe, vocabulary, None, device)
        saved = torch.load(path, map_location=device, weights_only=True)
        for name in ("network", "helpers", "average", "average_helpers", "optimiser"):
            getattr(training, name).load_state_dict(saved[name])
        training.step, training.cpu_s = saved["step"], saved["cpu_s"]
        return training

    def write(self, path: Path) -> None:
        """Save everything; an earlier file is replaced atomically. Raises StateError."""
        state: dict[str, object] = {
            "step": self.step,
            "cpu_s": self.cpu_s,
            "recipe": self.recipe.model_dump(mode="json"),
            "vocabulary": self.network.vocabulary,
        }
        for name in ("network", "helpers", "average", "average_helpers", "optimiser"):
            state[name] = getattr(self, name).state_dict()
        with replacing(path) as unfinished:
            torch.save(state, unfinished)

    def rate(self) -> float:
        """Learning rate of the next step: warm-up, constant, cool-down."""
        recipe = self.recipe
        left = (recipe.steps - self.step) / max(1.0, recipe.steps * recipe.cool_down)
        return recipe.rate * min(1.0, (self.step + 1) / recipe.warm_up, max(left, 0.0))

    def draw(self, shards: Shards, prompts: Prompts, weight: NDArray[np.float64]) -> Batch:
        """The batch of the next step; it has all visual tokens towards the end."""
        recipe = self.recipe
        views, tokens = recipe.views, recipe.tokens
        if self.step >= recipe.full_from * recipe.steps:
            views, tokens = recipe.full_views, PATCHES
        return draw(shards, prompts, weight, views, tokens, [recipe.seed, self.step])

    def advance(self, batch: Batch) -> dict[str, float]:
        """Run one step; returns its losses."""
        begun, recipe = time.process_time(), self.recipe
        rate = self.rate()
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        task = FlowTask.draw(batch, recipe.samples, recipe.seed * 1_000_003 + self.step)
        noisy, times = task.noisy(batch), task.times
        with half_precision(batch.state.device):
            prefix = self.network.read(batch.look, batch.ids, torch.bfloat16)
            thought = self.network(prefix, batch.state, noisy, times, torch.bfloat16)
        result = flow_losses(prefix, thought, self.helpers, batch, task)
        result.total.backward()  # type: ignore[no-untyped-call]
        parameters = [*self.network.parameters(), *self.helpers.parameters()]
        nn.utils.clip_grad_norm_(parameters, _CLIP)
        self.optimiser.step()
        self.optimiser.zero_grad()
        self.step += 1
        keep = min(_AVERAGE, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            averaged: list[Tensor] = [
                *self.average.parameters(),
                *self.average_helpers.parameters(),
            ]
            torch._foreach_lerp_(averaged, list[Tensor](parameters), 1.0 - keep)
        self.cpu_s += time.process_time() - begun
        return {**result.numbers(), "rate": rate}


def train_flow(
    recipe: FlowRecipe,
    directory: Path,
    data: Path,
    *,
    more: Sequence[int] = (),
    until: int | None = None,
    say: Say = print,
    log_every: int = 50,
    save_every_s: float = 120.0,
    measure_every: int = 1000,
    say_every_s: float = EVERY_S,
    preview_every_s: float = 120.0,
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
        log_every, measure_every: steps between entries, and between measurements on held-out views.
        save_every_s, say_every_s, preview_every_s: time between two saved states, two lines, and
            two metrics of a few held-out views.
        fuse: compile the layers first (needs a C++ compiler).
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
    if fuse:
        for layer in (*training.network.layers, *training.network.expert):
            layer.compile(dynamic=False)
    weight, last = sampling(shards), recipe.steps if until is None else min(until, recipe.steps)
    curve = Curve(directory / CURVE_FILE)
    size = sum(parameter.numel() for parameter in training.network.parameters())
    say(
        f"training: {size / 1e6:.2f} million parameters on {device.type}, at step "
        f"{training.step}, to step {last} of {recipe.steps}"
    )

    def measured(most: int | None = None) -> dict[str, float]:
        figures = measure_flow(
            training.average, training.average_helpers, held_out, prompts, device, most
        )
        say(f"  held out at step {training.step}: {figures}")
        return figures.as_dict()

    progress = Progress("step", last, training.step, say, every_s=say_every_s)
    saved_s = time.monotonic()
    previewed_s = saved_s - preview_every_s
    while training.step < last:
        batch = training.draw(shards, prompts, weight).to(device)
        numbers = training.advance(batch)
        curve.add(numbers)
        said = ", ".join(
            f"{name} {numbers[name]:.3g}" for name in ("total", "flow", "place", "accuracy")
        )
        is_said = progress.update(training.step, said)
        if is_said and time.monotonic() - previewed_s >= preview_every_s:
            measured(_PREVIEW_VIEWS)
            previewed_s = time.monotonic()
        if training.step % log_every == 0 or training.step == last:
            curve.flush(training)
        if training.step % measure_every == 0 or training.step == last:
            curve.note(training, measured())
            previewed_s = time.monotonic()
        if time.monotonic() - saved_s > save_every_s or training.step == last:
            training.write(state)
            saved_s = time.monotonic()
    return training

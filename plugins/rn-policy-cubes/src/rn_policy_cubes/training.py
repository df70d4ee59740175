"""The training loop: it may be interrupted any number of times, with the same result."""

from __future__ import annotations

import contextlib
import copy
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor, nn

from rn_policy_cubes.dataset import Batch, Shards, draw, sampling
from rn_policy_cubes.losses import Helpers, losses
from rn_policy_cubes.measure import measure
from rn_policy_cubes.network import CubesNetwork
from rn_policy_cubes.packing import Card, Packed, network_of
from rn_policy_cubes.progress import EVERY_S, Progress, Say
from rn_policy_cubes.recipe import PATCHES, Recipe
from rn_policy_cubes.replacing import replacing
from rn_policy_cubes.start import new_network
from rn_policy_cubes.words import Prompts, read_prompts, write_tokenizer
from roboneuron import ConfigurationError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

STATE_FILE, CURVE_FILE = "training.pt", "curve.jsonl"
_BETAS, _DECAY, _CLIP = (0.9, 0.98), 0.01, 1.0
_AVERAGE = 0.995
_PREVIEW_VIEWS = 32
"""Held-out views of a preview: they take seconds on a CPU and show whether training works."""


@dataclass
class Training:
    """The complete state of a training.

    Attributes:
        recipe: its settings.
        network, helpers: the trained modules.
        average: moving average of the network's weights, which is exported.
        average_helpers: likewise.
        step: steps done.
        cpu_s: CPU time of all steps.
    """

    recipe: Recipe
    network: CubesNetwork
    helpers: Helpers
    average: CubesNetwork
    average_helpers: Helpers
    optimiser: torch.optim.Optimizer
    step: int = 0
    cpu_s: float = 0.0

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
        network, helpers = network.to(device), Helpers(recipe.shape).to(device)
        parameters = [*network.parameters(), *helpers.parameters()]
        optimiser = torch.optim.AdamW(parameters, recipe.rate, betas=_BETAS, weight_decay=_DECAY)
        return cls(
            recipe, network, helpers, copy.deepcopy(network), copy.deepcopy(helpers), optimiser
        )

    @classmethod
    def read(cls, path: Path, recipe: Recipe, prompts: Prompts, device: torch.device) -> Training:
        """Resume from a file of `write`. The recipe may have another length, but not another
        shape.
        """
        training = cls.begin(recipe, prompts, None, device)
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
        }
        for name in ("network", "helpers", "average", "average_helpers", "optimiser"):
            state[name] = getattr(self, name).state_dict()
        with replacing(path) as unfinished:
            torch.save(state, unfinished)

    def rate(self) -> float:
        """Learning rate of the next step: warm-up, constant, cool-down."""
        recipe = self.recipe
        falling = max(1.0, recipe.steps * recipe.cool_down)
        left = (recipe.steps - self.step) / falling
        return recipe.rate * min(1.0, (self.step + 1) / recipe.warm_up, max(left, 0.0))

    def guidance(self) -> float:
        """Weight of the auxiliary losses."""
        return min(1.0, self.step / self.recipe.warm_up) if self.recipe.continues else 1.0

    def is_full(self) -> bool:
        """True if all visual tokens are used."""
        return (
            self.step >= self.recipe.full_from * self.recipe.steps or self.recipe.tokens >= PATCHES
        )

    def draw(self, shards: Shards, prompts: Prompts, weight: NDArray[np.float64]) -> Batch:
        """The batch of the next step."""
        recipe, full = self.recipe, self.is_full()
        views, tokens = (recipe.full_views, PATCHES) if full else (recipe.views, recipe.tokens)
        seed = [recipe.seed, self.step]
        return draw(shards, prompts, weight, views, tokens, seed, recipe.light)

    def advance(self, batch: Batch) -> dict[str, float]:
        """Run one step; returns its losses."""
        begun = time.process_time()
        rate = self.rate()
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        with half_precision(batch.state.device):
            thought = self.network(batch.look, batch.state, batch.ids, torch.bfloat16)
        result = losses(thought, self.helpers, batch, self.guidance())
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


def half_precision(device: torch.device) -> contextlib.AbstractContextManager[object]:
    """Context with bfloat16 matrix products; weights stay float32."""
    return torch.autocast(device.type, torch.bfloat16)


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
    log_every: int = 50,
    save_every_s: float = 120.0,
    measure_every: int = 1000,
    say_every_s: float = EVERY_S,
    preview_every_s: float = 120.0,
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
        log_every, measure_every: steps between entries, and between measurements on held-out views.
        save_every_s: time between two saved states.
        say_every_s: time between two lines.
        preview_every_s: time between metrics of a few held-out views; the first ones come with the
            first line.
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
    if fuse:
        for layer in training.network.layers:
            layer.compile(dynamic=False)
    weight, last = sampling(shards), recipe.steps if until is None else min(until, recipe.steps)
    curve = Curve(directory / CURVE_FILE)
    begins = f"at step {training.step}" if training.step else "from the beginning"
    size = sum(parameter.numel() for parameter in training.network.parameters())
    say(
        f"training: {size / 1e6:.2f} million parameters on {device.type}, {begins}, to step "
        f"{last} of {recipe.steps}"
    )
    progress = Progress("step", last, training.step, say, every_s=say_every_s)
    saved_s = time.monotonic()
    previewed_s = saved_s - preview_every_s
    while training.step < last:
        batch = training.draw(shards, prompts, weight).to(device)
        numbers = training.advance(batch)
        curve.add(numbers)
        if (
            progress.update(training.step, _told(numbers))
            and time.monotonic() - previewed_s >= preview_every_s
        ):
            few = measure(
                training.average,
                training.average_helpers,
                held_out,
                prompts,
                device,
                _PREVIEW_VIEWS,
            )
            say(
                f"  preview at step {training.step}, of {min(_PREVIEW_VIEWS, len(held_out))} "
                f"held-out views: {few}"
            )
            previewed_s = time.monotonic()
        if training.step % log_every == 0 or training.step == last:
            curve.flush(training)
        if training.step % measure_every == 0 or training.step == last:
            figures = measure(training.average, training.average_helpers, held_out, prompts, device)
            curve.note(training, figures.as_dict())
            say(f"  held out at step {training.step}: {figures}")
            previewed_s = time.monotonic()
        if time.monotonic() - saved_s > save_every_s or training.step == last:
            training.write(state)
            saved_s = time.monotonic()
    return training


def pack(directory: Path) -> Packed:
    """The averaged weights of a training, with the newest metrics of its curve.

    Raises:
        ConfigurationError: there is no training in the folder.
    """
    state = directory / STATE_FILE
    if not state.exists():
        raise ConfigurationError(
            f"{directory} holds no training.", hint="Start one: roboneuron cubes-policy train"
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


def newest_figures(curve: Path) -> dict[str, float]:
    """The newest metrics on held-out views in a training curve, by name; none without a file."""
    figures: dict[str, float] = {}
    for line in curve.read_text(encoding="utf-8").splitlines() if curve.exists() else ():
        # JSON has no NaN, the value of metrics without suitable held-out views
        figures |= {
            name: value
            for name, value in json.loads(line).items()
            if name.startswith("held_out_") and not math.isnan(value)
        }
    return figures


class Counted(Protocol):
    """A training that counts its steps and their CPU time."""

    step: int
    cpu_s: float


class Curve:
    """The training curve: losses by step, averaged between two lines of the file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._sums: dict[str, float] = {}
        self._count = 0

    def add(self, numbers: dict[str, float]) -> None:
        """Add the losses of one step."""
        for name, value in numbers.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        self._count += 1

    def flush(self, training: Counted) -> None:
        """Write the mean of the added losses."""
        self.note(training, {name: value / self._count for name, value in self._sums.items()})
        self._sums, self._count = {}, 0

    def note(self, training: Counted, numbers: dict[str, float]) -> None:
        """Write one line."""
        rounded = {
            name: value if math.isnan(value) else round(value, 5) for name, value in numbers.items()
        }
        line = {"step": training.step, "cpu_s": round(training.cpu_s, 1), **rounded}
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")


def _told(numbers: dict[str, float]) -> str:
    """The losses of a step as text for people."""
    return ", ".join(
        f"{name} {numbers[name]:.3g}" for name in ("total", "action", "place", "accuracy")
    )

"""What the trainings of both policies share: the state of a training, a step of the optimiser, and
the loop. A training may be interrupted any number of times, with the same result.
"""

from __future__ import annotations

import contextlib
import copy
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol, Self

import torch
from torch import Tensor, nn

from rn_policy_cubes.curve import CURVE_FILE, Curve
from rn_policy_cubes.dataset import Batch, Shards, draw, sampling
from rn_policy_cubes.progress import EVERY_S, Progress, Say
from rn_policy_cubes.recipe import PATCHES, TrainingRecipe
from rn_policy_cubes.replacing import replacing
from rn_policy_cubes.words import Prompts

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

STATE_FILE = "training.pt"
_MODULES = ("network", "helpers", "average", "average_helpers", "optimiser")
"""Parts of the state with a `state_dict`."""
_BETAS, _DECAY, _CLIP = (0.9, 0.98), 0.01, 1.0
_AVERAGE = 0.995
_PREVIEW_VIEWS = 32
"""Held-out views of a preview: they take seconds on a CPU and show whether training works."""


class StepLosses(Protocol):
    """Loss terms of a step."""

    @property
    def total(self) -> Tensor:
        """The sum to be minimised."""

    def numbers(self) -> dict[str, float]:
        """All terms, by name."""


class HeldOutFigures(Protocol):
    """Metrics on held-out views; as a string, a line for people."""

    def as_dict(self) -> dict[str, float]:
        """Entries of the training curve, named `held_out_...`."""


@dataclass(frozen=True, slots=True)
class Schedule:
    """How often a training writes and reports.

    Attributes:
        log_every: steps between two entries of the curve.
        measure_every: steps between two measurements on all held-out views.
        save_every_s: time between two saved states.
        say_every_s: time between two lines for people.
        preview_every_s: time between two measurements on a few held-out views; the first one comes
            with the first line.
    """

    log_every: int = 50
    measure_every: int = 1000
    save_every_s: float = 120.0
    say_every_s: float = EVERY_S
    preview_every_s: float = 120.0


USUAL = Schedule()


@dataclass
class Learner(ABC):
    """The complete state of a training.

    Attributes:
        recipe: its settings.
        network, helpers: the trained modules; the helpers are discarded after training.
        average, average_helpers: moving averages of their weights; the former is exported.
        step: steps done.
        cpu_s: CPU time of all steps.
    """

    TOLD: ClassVar[tuple[str, ...]]
    """Losses on a line for people."""

    recipe: TrainingRecipe
    network: nn.Module
    helpers: nn.Module
    average: nn.Module
    average_helpers: nn.Module
    optimiser: torch.optim.Optimizer
    step: int = 0
    cpu_s: float = 0.0

    @classmethod
    def of(cls, recipe: TrainingRecipe, network: nn.Module, helpers: nn.Module) -> Self:
        """A new training of two modules, which are on its device."""
        parameters = [*network.parameters(), *helpers.parameters()]
        optimiser = torch.optim.AdamW(parameters, recipe.rate, betas=_BETAS, weight_decay=_DECAY)
        return cls(
            recipe, network, helpers, copy.deepcopy(network), copy.deepcopy(helpers), optimiser
        )

    @property
    def device(self) -> torch.device:
        """Where the network is."""
        return next(self.network.parameters()).device

    def restore(self, path: Path) -> None:
        """Resume from a file of `write`. The recipe may have another length, but not another
        shape.
        """
        saved = torch.load(path, map_location=self.device, weights_only=True)
        for name in _MODULES:
            getattr(self, name).load_state_dict(saved[name])
        self.step, self.cpu_s = saved["step"], saved["cpu_s"]

    def write(self, path: Path) -> None:
        """Save everything; an earlier file is replaced atomically. Raises StateError."""
        state: dict[str, object] = {
            "step": self.step,
            "cpu_s": self.cpu_s,
            "recipe": self.recipe.model_dump(mode="json"),
            **self.more_state(),
        }
        for name in _MODULES:
            state[name] = getattr(self, name).state_dict()
        with replacing(path) as unfinished:
            torch.save(state, unfinished)

    def more_state(self) -> dict[str, object]:
        """What is saved besides, for whoever packs the weights."""
        return {}

    def rate(self) -> float:
        """Learning rate of the next step: warm-up, constant, cool-down."""
        recipe = self.recipe
        falling = max(1.0, recipe.steps * recipe.cool_down)
        left = (recipe.steps - self.step) / falling
        return recipe.rate * min(1.0, (self.step + 1) / recipe.warm_up, max(left, 0.0))

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
        result = self.losses_of(batch)
        result.total.backward()  # type: ignore[no-untyped-call]
        parameters = [*self.network.parameters(), *self.helpers.parameters()]
        nn.utils.clip_grad_norm_(parameters, _CLIP)
        self.optimiser.step()
        self.optimiser.zero_grad()
        self.step += 1
        keep = min(_AVERAGE, (1 + self.step) / (10 + self.step))
        averaged = [*self.average.parameters(), *self.average_helpers.parameters()]
        with torch.no_grad():
            torch._foreach_lerp_(list[Tensor](averaged), list[Tensor](parameters), 1.0 - keep)
        self.cpu_s += time.process_time() - begun
        return {**result.numbers(), "rate": rate}

    @abstractmethod
    def losses_of(self, batch: Batch) -> StepLosses:
        """Losses of the network on a batch of the training's device."""

    @abstractmethod
    def measured(
        self, held_out: Shards, prompts: Prompts, most: int | None = None
    ) -> HeldOutFigures:
        """Metrics of the averaged weights, over all views or `most` of them."""

    @abstractmethod
    def layers(self) -> Iterable[nn.Module]:
        """The layers that can be compiled."""


def half_precision(device: torch.device) -> contextlib.AbstractContextManager[object]:
    """Context with bfloat16 matrix products; weights stay float32."""
    return torch.autocast(device.type, torch.bfloat16)


def learn(
    training: Learner,
    directory: Path,
    shards: Shards,
    held_out: Shards,
    prompts: Prompts,
    *,
    until: int | None = None,
    say: Say = print,
    schedule: Schedule = USUAL,
    fuse: bool = False,
) -> None:
    """Train until step `until` (default: the recipe's last). State and curve are in `directory`;
    `say` is called with lines for people. `fuse` compiles the layers first (needs a C++ compiler),
    which halves the time on a CPU.
    """
    if fuse:
        for layer in training.layers():
            layer.compile(dynamic=False)
    steps = training.recipe.steps
    weight, last = sampling(shards), steps if until is None else min(until, steps)
    curve = Curve(directory / CURVE_FILE)
    begins = f"at step {training.step}" if training.step else "from the beginning"
    size = sum(parameter.numel() for parameter in training.network.parameters())
    say(
        f"training: {size / 1e6:.2f} million parameters on {training.device.type}, {begins}, to "
        f"step {last} of {steps}"
    )
    progress = Progress("step", last, training.step, say, every_s=schedule.say_every_s)
    saved_s = time.monotonic()
    previewed_s = saved_s - schedule.preview_every_s
    while training.step < last:
        batch = training.draw(shards, prompts, weight).to(training.device)
        numbers = training.advance(batch)
        curve.add(numbers)
        told = ", ".join(f"{name} {numbers[name]:.3g}" for name in training.TOLD)
        is_said = progress.update(training.step, told)
        if is_said and time.monotonic() - previewed_s >= schedule.preview_every_s:
            few = training.measured(held_out, prompts, _PREVIEW_VIEWS)
            views = min(_PREVIEW_VIEWS, len(held_out))
            say(f"  preview at step {training.step}, of {views} held-out views: {few}")
            previewed_s = time.monotonic()
        is_last = training.step == last
        if training.step % schedule.log_every == 0 or is_last:
            curve.flush(training.step, training.cpu_s)
        if training.step % schedule.measure_every == 0 or is_last:
            figures = training.measured(held_out, prompts)
            curve.note(training.step, training.cpu_s, figures.as_dict())
            say(f"  held out at step {training.step}: {figures}")
            previewed_s = time.monotonic()
        if time.monotonic() - saved_s > schedule.save_every_s or is_last:
            training.write(directory / STATE_FILE)
            saved_s = time.monotonic()

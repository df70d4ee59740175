"""Training of the monitor's network; it continues from its state file."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from rn_policy_cubes.demonstrations import COLOURS
from rn_policy_cubes.monitor.layers import (
    CLOSE_CHANNELS,
    F32,
    HIDDEN_WIDTH,
    OUTPUTS,
    STATE_WIDTH,
    WHOLE_CHANNELS,
    WHOLE_WIDTH,
    flat_widths,
    scaled,
)
from rn_policy_cubes.monitor.samples import Samples
from rn_policy_cubes.progress import Progress, Say
from rn_policy_cubes.replacing import replacing
from roboneuron import ConfigurationError

STATE_FILE = "monitor-state.pt"
_SAVE_EVERY = 200
_SHIFT_PX = 2


class MonitorRecipe(BaseModel):
    """Recipe of a training."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    steps: int = Field(default=700, ge=1, description="optimiser steps")
    views: int = Field(default=64, ge=1, description="views of a step")
    rate: float = Field(default=2e-3, gt=0, description="highest learning rate")
    decay: float = Field(default=1e-3, ge=0, description="weight decay")
    seed: int = Field(default=1, ge=0, description="of the weights and the order of views")


class MonitorNetwork(nn.Module):
    """The network for training; `layers.MonitorLayers` computes the same."""

    def __init__(self) -> None:
        super().__init__()
        near, far = flat_widths()
        self.close = _stack(CLOSE_CHANNELS)
        self.whole = _stack(WHOLE_CHANNELS)
        self.squeeze = nn.Linear(far, WHOLE_WIDTH)
        self.hidden = nn.Linear(near + WHOLE_WIDTH + STATE_WIDTH, HIDDEN_WIDTH)
        self.out = nn.Linear(HIDDEN_WIDTH, len(OUTPUTS) * len(COLOURS))

    def forward(self, close: Tensor, whole: Tensor, state: Tensor) -> Tensor:
        """Logits (n, 3, colours) for views (n, 3, 48, 48), (n, 3, 56, 56) and states (n, 4)."""
        near, far = _run(self.close, close), _run(self.whole, whole)
        far = torch.relu(self.squeeze(far))
        hidden = torch.relu(self.hidden(torch.cat([near, far, state], dim=1)))
        told: Tensor = self.out(hidden)
        return told.view(len(told), len(OUTPUTS), -1)

    def tensors(self) -> dict[str, F32]:
        """The trained tensors as `layers.MonitorLayers` wants them."""
        return {name: value.detach().float().numpy() for name, value in self.state_dict().items()}


def _stack(channels: tuple[int, ...]) -> nn.ModuleList:
    pairs = zip((3, *channels[:-1]), channels, strict=True)
    return nn.ModuleList(nn.Conv2d(first, last, 3, 2, 1) for first, last in pairs)


def _run(stack: nn.ModuleList, value: Tensor) -> Tensor:
    for layer in stack:
        value = torch.relu(layer(value))
    return value.flatten(1)


def fit(
    samples: Samples, recipe: MonitorRecipe, out: Path, say: Say, until: int | None = None
) -> tuple[MonitorNetwork, int]:
    """Train, or continue; returns the network and the number of steps done.

    A step depends only on the recipe and its number.
    Raises:
        ConfigurationError: the state in `out` belongs to another recipe.
        StateError: the disk is full.
    """
    torch.manual_seed(recipe.seed)
    network = MonitorNetwork()
    optimiser = torch.optim.AdamW(network.parameters(), lr=recipe.rate, weight_decay=recipe.decay)
    done, path = 0, out / STATE_FILE
    if path.exists():
        state: Mapping[str, object] = torch.load(path, weights_only=True)
        if state["recipe"] != recipe.model_dump_json():
            raise ConfigurationError(
                f"{path} belongs to another recipe.", hint="Name another folder with --out."
            )
        network.load_state_dict(state["network"])  # type: ignore[arg-type]
        optimiser.load_state_dict(state["optimiser"])  # type: ignore[arg-type]
        done = int(state["step"])  # type: ignore[call-overload]
    last = min(recipe.steps, until or recipe.steps)
    progress, begun = Progress("step", last, done, say), time.process_time()
    for step in range(done, last):
        for group in optimiser.param_groups:
            group["lr"] = recipe.rate * _warmth(step, recipe.steps)
        loss = _loss(network, samples, recipe, step)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        if (step + 1) % _SAVE_EVERY == 0 or step + 1 == last:
            out.mkdir(parents=True, exist_ok=True)
            with replacing(path) as unfinished:
                torch.save(
                    {
                        "recipe": recipe.model_dump_json(),
                        "network": network.state_dict(),
                        "optimiser": optimiser.state_dict(),
                        "step": step + 1,
                    },
                    unfinished,
                )
        progress.update(step + 1, f"loss {loss.item():.4f}")
    say(f"CPU time of these steps: {time.process_time() - begun:.0f} s")
    return network, max(done, last)


def _warmth(step: int, steps: int) -> float:
    """Share of the learning rate: a short rise, then half a cosine."""
    rise = min(1.0, (step + 1) / 100)
    return rise * 0.5 * (1.0 + float(np.cos(np.pi * step / steps)))


def _loss(network: MonitorNetwork, samples: Samples, recipe: MonitorRecipe, step: int) -> Tensor:
    random = np.random.default_rng([recipe.seed, step])
    chosen = random.integers(len(samples), size=recipe.views)
    close = _shifted(scaled(samples.close[chosen]), random)
    whole = scaled(samples.whole[chosen])
    close, whole = _lit(close, whole, random)
    state = samples.state[chosen] + random.normal(0, 0.02, (recipe.views, STATE_WIDTH))
    told = network(
        torch.from_numpy(close), torch.from_numpy(whole), torch.from_numpy(state.astype(np.float32))
    )
    label = torch.from_numpy(samples.labels[chosen])
    known = torch.from_numpy(samples.known[chosen])
    cross = nn.functional.binary_cross_entropy_with_logits(told, label, reduction="none")
    return (cross * known).sum(dim=(0, 2)).mean() / recipe.views


def _shifted(close: F32, random: np.random.Generator) -> F32:
    """Each close view moved by up to two pixels, as a calibration may be wrong."""
    moved = close.copy()
    for index, (down, right) in enumerate(
        random.integers(-_SHIFT_PX, _SHIFT_PX + 1, (len(close), 2))
    ):
        moved[index] = np.roll(close[index], (down, right), axis=(1, 2))
    return moved


def _lit(close: F32, whole: F32, random: np.random.Generator) -> tuple[F32, F32]:
    """Both views of each picture with another light, contrast and noise."""
    count = len(close)
    gain = random.uniform(0.85, 1.15, (count, 1, 1, 1)) * random.uniform(
        0.96, 1.04, (count, 3, 1, 1)
    )
    shift = random.uniform(-0.12, 0.12, (count, 1, 1, 1))
    noise = random.uniform(0.0, 0.06, (count, 1, 1, 1))
    return (
        (close * gain + shift + noise * random.standard_normal(close.shape)).astype(np.float32),
        (whole * gain + shift + 0.3 * noise * random.standard_normal(whole.shape)).astype(
            np.float32
        ),
    )

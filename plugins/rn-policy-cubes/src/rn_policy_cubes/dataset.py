"""Shards in memory, and the batch of a step, which depends only on seed and step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rn_policy_cubes.demonstrations import COLOURS, shard_files
from rn_policy_cubes.labels import Labels, coloured_share, label, patches_of
from rn_policy_cubes.network import Look
from rn_policy_cubes.recipe import PATCHES, ROWS
from rn_policy_cubes.words import Prompts

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]

COLOURED = 0.10
"""Fraction of a patch's pixels from which it counts as showing a cube."""
_SLIGHTLY_COLOURED = 0.03
_STATE_NOISE = 0.004
_NEAR_M, _NEAR_WEIGHT = 0.10, 1.6
_BRIGHTNESS, _TINT, _MOST_NOISE = (0.55, 1.15), 0.15, 10.0
"""Range of the gain of all channels, most that one channel differs from it, and the largest
standard deviation of the noise, of 255.
"""


@dataclass(frozen=True, slots=True)
class Shards:
    """Whole shards.

    Attributes:
        patches: uint8 (n, 256, 588).
        share: float32 (n, 256, colours), fraction of each patch that shows a cube.
        labels: labels of n views.
    """

    patches: U8
    share: F32
    labels: Labels

    @classmethod
    def load(cls, directory: Path, numbers: Sequence[int], length: int = ROWS) -> Shards:
        """Read shards, with labels of `length` actions. Raises FileNotFoundError if one is
        missing.
        """
        patches, shares, labels = [], [], []
        for number in numbers:
            rows, pictures = (np.load(path) for path in shard_files(directory, number))
            patches.append(patches_of(pictures))
            shares.append(coloured_share(patches[-1]))
            labels.append(label(rows, length))
        parts = zip(patches, shares, labels, strict=True)
        return cls.joined([cls(*part) for part in parts])

    @classmethod
    def joined(cls, parts: Sequence[Shards]) -> Shards:
        """Concatenate the parts."""
        if len(parts) == 1:
            return parts[0]
        labels = {
            field.name: np.concatenate([getattr(part.labels, field.name) for part in parts])
            for field in fields(Labels)
        }
        patches = np.concatenate([part.patches for part in parts])
        return cls(patches, np.concatenate([part.share for part in parts]), Labels(**labels))

    def __len__(self) -> int:
        return len(self.patches)


@dataclass(frozen=True, slots=True)
class Batch:
    """Input of one training step; pairs are views x colours.

    Attributes:
        look: images.
        state: (views, 7).
        ids: (views, colours, n).
        actions: (pairs, length, 7).
        place: (pairs, 5).
        known, placed: (pairs,) float, 1 if `actions`, or `place`, is a valid label.
        distance_m: (pairs,).
        shows_named: (pairs, tokens) bool, the token shows the named cube.
        shows_other: (pairs, tokens) bool, it shows another one and not the named one.
    """

    look: Look
    state: Tensor
    ids: Tensor
    actions: Tensor
    place: Tensor
    known: Tensor
    placed: Tensor
    distance_m: Tensor
    shows_named: Tensor
    shows_other: Tensor

    def to(self, device: torch.device) -> Batch:
        """The same on another device."""
        weight = None if self.look.weight is None else self.look.weight.to(device)
        look = Look(self.look.pixels.to(device), self.look.index.to(device), weight)
        rest = {
            field.name: getattr(self, field.name) for field in fields(self) if field.name != "look"
        }
        return Batch(look=look, **{name: value.to(device) for name, value in rest.items()})


def sampling(shards: Shards) -> NDArray[np.float64]:
    """Probability of each view in sampling: views near the grasp are drawn more often."""
    near = (
        np.where(shards.labels.is_target, shards.labels.distance_m, np.inf).min(axis=1) < _NEAR_M
    ).astype(float)
    weight = 1.0 + (_NEAR_WEIGHT - 1.0) * near
    return np.asarray(weight / weight.sum())


def draw(
    shards: Shards,
    prompts: Prompts,
    weight: NDArray[np.float64],
    views: int,
    tokens: int,
    seed: Sequence[int],
    light: float = 0.0,
) -> Batch:
    """The batch of a training step, by its seed; `light` as in the recipe."""
    random = np.random.default_rng(seed)
    chosen = random.choice(len(shards), views, p=weight)
    ids = prompts.by_length[int(random.choice(len(prompts.by_length), p=prompts.share))]
    sentence = random.integers(len(ids), size=(views, len(COLOURS)))
    noise = random.normal(0.0, _STATE_NOISE, (views, shards.labels.state.shape[1]))
    batch = _batch(shards, chosen, ids[sentence, np.arange(len(COLOURS))], noise, tokens, random)
    if light:
        pixels = torch.from_numpy(relit(batch.look.pixels.numpy(), light, random))
        return replace(batch, look=replace(batch.look, pixels=pixels))
    return batch


def relit(pixels: U8, share: float, random: np.random.Generator) -> U8:
    """Patches (n, tokens, 588) in other light: about `share` of the n views get a random
    brightness, tint and noise.
    """
    views, tokens, values = pixels.shape
    darkest, brightest = _BRIGHTNESS
    gain = random.uniform(darkest, brightest, (views, 1, 1, 1))
    tint = random.uniform(1 - _TINT, 1 + _TINT, (views, 1, 3, 1))
    spread = random.uniform(0.0, _MOST_NOISE, (views, 1, 1, 1))
    noise = spread * random.standard_normal((views, tokens, 3, values // 3), dtype=np.float32)
    changed = pixels.reshape(views, tokens, 3, -1) * (gain * tint).astype(np.float32) + noise
    whole = np.clip(np.rint(changed), 0, 255).astype(np.uint8).reshape(pixels.shape)
    return np.where(random.random((views, 1, 1)) < share, whole, pixels)


def every(shards: Shards, prompts: Prompts, views: int, most: int | None = None) -> Sequence[Batch]:
    """All views in order, or `most` evenly spaced ones; all tokens, plain sentences: for
    measuring.
    """
    random = np.random.default_rng(0)
    wanted = np.arange(len(shards))
    if most is not None and most < len(shards):
        wanted = np.linspace(0, len(shards) - 1, most).astype(int)
    batches = []
    for first in range(0, len(wanted), views):
        chosen = wanted[first : first + views]
        ids = prompts.by_length[0][np.arange(len(chosen)) % len(prompts.by_length[0])]
        batches.append(_batch(shards, chosen, ids, np.zeros((len(chosen), 1)), PATCHES, random))
    return batches


def _batch(
    shards: Shards,
    chosen: NDArray[np.int64],
    ids: NDArray[np.int64],
    noise: NDArray[np.float64],
    tokens: int,
    random: np.random.Generator,
) -> Batch:
    share = shards.share[chosen]
    index, weight = _tokens(share.sum(axis=-1), tokens, random)
    # (views, colours, tokens)
    seen = np.take_along_axis(share, index[..., None], axis=1).transpose(0, 2, 1)
    named = seen > COLOURED
    other = (seen.sum(axis=1, keepdims=True) - seen > COLOURED) & (seen < _SLIGHTLY_COLOURED)
    labels = shards.labels
    tensor = torch.from_numpy
    return Batch(
        look=Look(
            pixels=tensor(shards.patches[chosen[:, None], index]),
            index=tensor(index),
            weight=None if weight is None else tensor(weight),
        ),
        state=tensor((labels.state[chosen] + noise).astype(np.float32)),
        ids=tensor(ids),
        actions=tensor(labels.actions[chosen]).flatten(0, 1),
        place=tensor(labels.place[chosen]).flatten(0, 1),
        known=tensor(labels.known[chosen].astype(np.float32)).flatten(0, 1),
        placed=tensor(np.repeat(labels.is_placed[chosen].astype(np.float32), len(COLOURS))),
        distance_m=tensor(labels.distance_m[chosen]).flatten(0, 1),
        shows_named=tensor(named).flatten(0, 1),
        shows_other=tensor(other).flatten(0, 1),
    )


def _tokens(
    coloured: F32, tokens: int, random: np.random.Generator
) -> tuple[NDArray[np.int64], F32 | None]:
    """Indices of the sampled patches, and the number of patches that each represents.

    Patches with cubes are always included and represent themselves. A random sample of the others
    represents all others, so that attention, which weights keys by these numbers, is on average the
    same as with all 256.
    """
    views = len(coloured)
    if tokens >= PATCHES:
        return np.broadcast_to(np.arange(PATCHES), (views, PATCHES)).copy(), None
    salient = coloured > _SLIGHTLY_COLOURED
    order = random.random(coloured.shape) - 2.0 * salient
    index = np.sort(np.argpartition(order, tokens, axis=1)[:, :tokens], axis=1)
    kept = np.take_along_axis(salient, index, axis=1)
    others = PATCHES - salient.sum(axis=1)
    each = others / np.maximum(1, (~kept).sum(axis=1))
    return index, np.where(kept, 1.0, each[:, None]).astype(np.float32)

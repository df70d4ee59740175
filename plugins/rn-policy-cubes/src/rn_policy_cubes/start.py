"""Initial weights of the network: filters from the images, and smooth position embeddings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from rn_policy_cubes.dataset import COLOURED, Shards
from rn_policy_cubes.network import PIXELS, CubesNetwork, CubesVisionTower
from rn_policy_cubes.recipe import GRID, PATCH_VALUES, NetworkShape

POSITION_SHARE = 4
"""One of this number of a tower's channels is for the position."""
_SAMPLE = 20_000
FILTER_SIZE = 0.7


def new_network(shape: NetworkShape, ids: Sequence[int], shards: Shards, seed: int) -> CubesNetwork:
    """A network whose patch filters are the principal components of patches with cubes.

    Three quarters of a tower's channels start as such filters, with the components distributed over
    the towers; the others start as smooth functions of the patch's position in the image. All
    weights are trained afterwards.
    """
    torch.manual_seed(seed)
    network = CubesNetwork(shape, ids)
    random = np.random.default_rng([seed, 1])
    values = coloured_patches(shards, random)
    for number, tower in enumerate(network.towers):
        assert isinstance(tower, CubesVisionTower)
        _set_filters(tower, number, values)
        _set_positions(tower, number, random)
    return network


def coloured_patches(shards: Shards, random: np.random.Generator) -> Tensor:
    """A sample of the patches that show cubes, (n, 588) in 0 .. 1."""
    coloured = np.argwhere(shards.share.sum(axis=-1) > COLOURED)
    sample = coloured[random.permutation(len(coloured))[:_SAMPLE]]
    return torch.from_numpy(shards.patches[sample[:, 0], sample[:, 1]]).float() / 255


@torch.no_grad()
def _set_filters(tower: CubesVisionTower, number: int, values: Tensor) -> None:
    mean, spread = (torch.tensor(v).repeat_interleave(PATCH_VALUES // 3) for v in PIXELS[number])
    normalised = (values - mean) / spread
    centre = normalised.mean(dim=0)
    width = tower.patch.out_features
    filters = min(width - width // POSITION_SHARE, len(values) // 2)
    _, strength, components = torch.linalg.svd(normalised - centre, full_matrices=False)
    chosen = slice(number, 2 * filters, 2)  # even ones to one tower, odd ones to the other
    scale = (
        FILTER_SIZE
        * len(values) ** 0.5
        / strength[chosen, None].clamp(min=1e-3 * float(strength[0]))
    )
    weight = components[chosen] * scale
    tower.patch.weight.zero_()
    tower.patch.bias.zero_()
    tower.patch.weight[: len(weight)] = weight
    tower.patch.bias[: len(weight)] = -weight @ centre


@torch.no_grad()
def _set_positions(tower: CubesVisionTower, number: int, random: np.random.Generator) -> None:
    width = tower.pos_embed.shape[-1]
    count = width // POSITION_SHARE
    places = position_functions(count)
    if number:  # the other tower gets mixtures of more functions
        more = position_functions(2 * count)
        mix = torch.from_numpy(random.normal(size=(2 * count, count)) / (2 * count) ** 0.5).float()
        places = more @ mix * 1.5
    tower.pos_embed[0, :, width - count :] = places


def position_functions(count: int) -> Tensor:
    """Smooth functions of a patch's position in the image, (patches, count)."""
    across = torch.linspace(-1, 1, GRID).repeat(GRID)
    down = torch.linspace(-1, 1, GRID).repeat_interleave(GRID)
    functions = [across, down, across * down, across**2 - 0.35, down**2 - 0.35]
    for waves in range(1, count):
        functions += [torch.sin(waves * 1.5 * across), torch.cos(waves * 1.5 * across)]
        functions += [torch.sin(waves * 1.5 * down), torch.cos(waves * 1.5 * down)]
    return torch.stack(functions[:count], dim=-1)

"""Initial weights of the flow network, as in the other policy: filters from the images, and smooth
position embeddings.
"""

from __future__ import annotations

import numpy as np
import torch

from rn_policy_cubes.dataset import Shards
from rn_policy_cubes.flow.network import CubesFlowNetwork
from rn_policy_cubes.flow.recipe import FlowShape
from rn_policy_cubes.start import (
    FILTER_SIZE,
    POSITION_SHARE,
    coloured_patches,
    position_functions,
)


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

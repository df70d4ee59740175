"""The exported flow policy is the same function in rn-backend-pi0 as in training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from rn_backend_pi0.cli import main as check_pi0
from rn_backend_pi0.layouts import read_checkpoint
from rn_backend_pi0.model import Pi0Model
from rn_policy_cubes.flow.checkpoint import flow_configuration, unpack_flow
from rn_policy_cubes.flow.measure import EULER_STEPS
from rn_policy_cubes.flow.network import CubesFlowNetwork, chunk_shape
from rn_policy_cubes.flow.packing import FlowCard, FlowPacked
from rn_policy_cubes.flow.recipe import STATE_MEAN, STATE_STD, FlowRecipe, FlowShape
from rn_policy_cubes.flow.words import read_flow_prompts, write_flow_tokenizer
from rn_policy_cubes.labels import patches_of
from rn_policy_cubes.network import Look
from rn_policy_cubes.packing import Packed
from rn_policy_cubes.recipe import PATCHES
from rn_policy_cubes.weights import shipped_weights
from roboneuron import ConfigurationError

SHAPE = FlowShape(
    vision_width=32,
    vision_heads=2,
    vision_inner=48,
    hidden=24,
    intermediate=40,
    expert=16,
    expert_intermediate=24,
    layers=3,
    heads=2,
    head_width=8,
)


@pytest.fixture
def packed(tmp_path: Path) -> FlowPacked:
    """Random weights, in which no parameter has its neutral initial value."""
    torch.manual_seed(3)
    vocabulary = write_flow_tokenizer(tmp_path / "tokenizer.json")
    network = CubesFlowNetwork(SHAPE, vocabulary)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    card = FlowCard(recipe=FlowRecipe(shape=SHAPE), vocabulary=vocabulary, step=7, cpu_s=1.0)
    return FlowPacked.of(network, card)


def test_backend_samples_the_same_actions_from_the_same_noise(
    packed: FlowPacked, tmp_path: Path
) -> None:
    folder = tmp_path / "policy"
    unpack_flow(packed, folder)
    model = Pi0Model(read_checkpoint(folder), device="cpu", dtype="float32")
    random = np.random.default_rng(0)
    picture = random.integers(0, 256, (224, 224, 3), dtype=np.uint8)
    state = random.uniform(-1, 1, 7).astype(np.float32)
    noise = random.standard_normal(chunk_shape(), dtype=np.float32)
    ids = read_flow_prompts(folder / "tokenizer.json").by_length[0][0, 2]
    raw = state * np.array(STATE_STD) + np.array(STATE_MEAN)
    theirs = model.infer([picture], ids.tolist(), raw, noise)
    look = Look(
        pixels=torch.from_numpy(patches_of(picture[None])),
        index=torch.arange(PATCHES)[None],
        weight=None,
    )
    ours = packed.network().sample(
        look,
        torch.from_numpy(state)[None],
        torch.from_numpy(ids)[None, None],
        torch.from_numpy(noise)[None],
        EULER_STEPS,
    )
    assert np.abs(theirs - noise).max() > 0.1
    np.testing.assert_allclose(ours[0].numpy(), theirs, atol=1e-4)  # float32, another order of sums


def test_samples_of_a_pair_do_not_see_each_other(packed: FlowPacked) -> None:
    network = packed.network().eval()
    random = torch.Generator().manual_seed(1)
    look = Look(
        pixels=torch.randint(0, 256, (2, 9, 588), generator=random).to(torch.uint8),
        index=torch.arange(9).expand(2, -1),
        weight=torch.full((2, 9), 28.0),
    )
    ids, state = torch.randint(5, 90, (2, 3, 7), generator=random), torch.zeros(2, 7)
    noisy = torch.randn(6, 2, *chunk_shape(), generator=random)
    times = torch.rand(6, 2, generator=random)
    with torch.no_grad():
        prefix = network.read(look, ids)
        together = network(prefix, state, noisy, times).velocity
        alone = network(prefix, state, noisy[:, 1:], times[:, 1:]).velocity
    torch.testing.assert_close(together[:, 1:], alone, atol=1e-5, rtol=1e-4)
    assert not torch.allclose(together[:, 0], together[:, 1], atol=1e-2)


def test_unpacked_folder_passes_the_check_of_the_backend(
    packed: FlowPacked, tmp_path: Path
) -> None:
    folder = tmp_path / "policy"
    unpack_flow(packed, folder)
    assert check_pi0(["check", str(folder)]) == 0
    assert f'checkpoint = "{folder}"' in flow_configuration(folder)
    with pytest.raises(ConfigurationError, match="not an empty directory"):
        unpack_flow(packed, folder)


def test_packed_file_holds_the_weights_and_refuses_those_of_the_other_policy(
    packed: FlowPacked, tmp_path: Path
) -> None:
    packed.write(tmp_path / "flow.safetensors")
    again = FlowPacked.read(tmp_path / "flow.safetensors")
    assert again.card == packed.card
    for name, value in packed.network().state_dict().items():
        torch.testing.assert_close(again.network().state_dict()[name], value, atol=0, rtol=0)
    with pytest.raises(ConfigurationError, match="no packed flow policy"):
        FlowPacked.read(shipped_weights())
    with pytest.raises(KeyError):
        Packed.read(tmp_path / "flow.safetensors")

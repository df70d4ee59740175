"""Packed weights become a public checkpoint; the backend computes the same as the trained
network.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from rn_backend_oft.backend import OftPrimaryBackend
from rn_backend_oft.config import OftConfig
from rn_backend_oft.policy import OftPolicy
from rn_policy_cubes.checkpoint import CONFIGURATION_FILE, OPTIONS, SERVED_FILE, unpack
from rn_policy_cubes.demonstrations import ROW
from rn_policy_cubes.labels import patches_of, state_of
from rn_policy_cubes.network import CubesNetwork, Look
from rn_policy_cubes.packing import EMBEDDING, Card, Packed, network_of
from rn_policy_cubes.recipe import ACTION_SCALE, PATCHES, ROWS, Recipe
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.runtime import TorchRuntime
from roboneuron import ConfigurationError, Frame, Observation, Pose, quaternion_from_matrix
from roboneuron.config import load_config

INSTRUCTION = "pick up the blue cube"


@pytest.fixture
def packed(network: CubesNetwork, recipe: Recipe) -> Packed:
    return Packed.of(
        network, Card(recipe=recipe, step=3, cpu_s=0.5, figures={"held_out_place_mm": 12.5})
    )


@pytest.fixture
def checkpoint(packed: Packed, tmp_path: Path) -> Path:
    unpack(packed, tmp_path / "checkpoint")
    return tmp_path / "checkpoint"


@pytest.fixture
def backend(checkpoint: Path) -> OftPrimaryBackend:
    runtime = TorchRuntime(TorchRuntimeConfig(device="cpu", threads=1, dtype="float32"))
    backend = OftPrimaryBackend(
        OftConfig.model_validate({"checkpoint": checkpoint, **OPTIONS}), runtime=runtime
    )
    backend.load()
    return backend


def test_packing_loses_nothing(network: CubesNetwork, packed: Packed, tmp_path: Path) -> None:
    packed.write(tmp_path / "packed.safetensors")
    again = Packed.read(tmp_path / "packed.safetensors")
    assert again.card == packed.card
    restored = network_of(again).state_dict()
    for name, value in network.state_dict().items():
        assert torch.equal(value, restored[name]), name


def test_the_default_shape_packs_into_less_than_8_megabytes(
    prompts: object, tmp_path: Path
) -> None:
    recipe = Recipe()
    network = CubesNetwork(recipe.shape, prompts.in_use)  # type: ignore[attr-defined]
    Packed.of(network, Card(recipe=recipe, step=0, cpu_s=0.0)).write(
        tmp_path / "packed.safetensors"
    )
    assert (tmp_path / "packed.safetensors").stat().st_size < 8e6


def test_rows_that_were_left_out_are_zero(packed: Packed, checkpoint: Path) -> None:
    with safe_open(checkpoint / "model.safetensors", framework="pt") as file:
        table = file.get_tensor(EMBEDDING)
        logits = file.get_tensor("language_model.lm_head.weight")
    assert torch.equal(table[packed.ids], packed.tensors[EMBEDDING])
    rest = torch.ones(len(table), dtype=torch.bool)
    rest[packed.ids] = False
    assert not table[rest].any()
    assert not logits.any()


def test_the_backend_computes_what_the_network_computes(
    network: CubesNetwork, backend: OftPrimaryBackend
) -> None:
    """With generated images, state and words, so preprocessing, tokens and normalisation are
    compared too.
    """
    random = np.random.default_rng(0)
    picture = random.integers(0, 256, (224, 224, 3), dtype=np.uint8)
    row = np.zeros((), dtype=ROW)
    row["tcp_m"], row["opening"] = (0.45, 0.1, 0.2), 0.7
    row["rotation"] = np.diag([1.0, -1.0, -1.0])
    pose = Pose(
        position_m=row["tcp_m"].astype(np.float64),
        quaternion_xyzw=quaternion_from_matrix(row["rotation"].astype(np.float64)),
        stamp_ns=1,
    )
    frame = Frame(camera="front", image=picture, stamp_ns=1, frame_id="front", calibration=None)
    observation = Observation(
        frames={"primary": frame},
        instruction=INSTRUCTION,
        ee_pose=pose,
        gripper_open=float(row["opening"]),
        stamp_ns=1,
    )
    chunk = backend.predict(observation)
    ids = backend._encoder.to_ids(backend._encoder.to_text(INSTRUCTION))
    look = Look(torch.from_numpy(patches_of(picture[None])), torch.arange(PATCHES)[None], None)
    with torch.no_grad():
        thought = network(
            look, torch.from_numpy(state_of(row))[None], torch.from_numpy(ids)[None, None]
        )
    expected = thought.actions[0].numpy()
    assert chunk.actions.shape == (ROWS, 7)
    assert chunk.actions[:, :6] / ACTION_SCALE == pytest.approx(expected[:, :6], abs=1e-5)
    assert np.abs(expected[:, :6]).max() > 0.05
    assert (chunk.actions[:, 6] == (expected[:, 6] > 0.5)).all()


def test_a_weighted_token_counts_as_often_as_it_says(
    network: CubesNetwork, prompts: object
) -> None:
    """Two equal patches, of which one is left out and the other counts twice, in a network without
    position embeddings.
    """
    with torch.no_grad():
        for tower in network.towers:
            tower.pos_embed.zero_()
        network.cos.fill_(1.0)
        network.sin.fill_(0.0)
    pixels = torch.randint(0, 256, (1, PATCHES, 588), dtype=torch.uint8)
    pixels[:, 1::2] = pixels[:, ::2]
    state, ids = torch.zeros(1, 7), torch.from_numpy(prompts.by_length[0][:1, :1])  # type: ignore[attr-defined]
    index = torch.arange(PATCHES)[None]
    with torch.no_grad():
        whole = network(Look(pixels, index, None), state, ids).actions
        half = Look(pixels[:, ::2], index[:, ::2], torch.full((1, PATCHES // 2), 2.0))
        assert torch.allclose(network(half, state, ids).actions, whole, atol=1e-5)
        unweighted = Look(half.pixels, half.index, None)
        assert not torch.allclose(network(unweighted, state, ids).actions, whole, atol=1e-5)


def test_the_configuration_beside_it_runs_it(checkpoint: Path) -> None:
    config = load_config(checkpoint / CONFIGURATION_FILE)
    assert config.inference is not None
    assert config.inference.backend == "oft-primary"
    options = OftConfig.model_validate(config.plugins["oft-primary"])
    assert options.checkpoint == checkpoint
    assert options.platform().chunk == ROWS


def test_the_file_of_a_policy_server_beside_it_serves_it(checkpoint: Path) -> None:
    served = tomllib.loads((checkpoint / SERVED_FILE).read_text(encoding="utf-8"))
    assert list(served) == ["models"], "it listens on loopback unless a person says otherwise"
    model = served["models"]["cubes"]
    assert model["backend"] == "oft-primary"
    assert Path(model["checkpoint"]) == checkpoint
    options = OftConfig.model_validate({**model["options"], "checkpoint": model["checkpoint"]})
    assert options.platform().chunk == ROWS


def test_a_folder_with_something_in_it_is_not_written_to(packed: Packed, checkpoint: Path) -> None:
    with pytest.raises(ConfigurationError, match="not an empty directory"):
        unpack(packed, checkpoint)


def test_the_layout_is_that_of_the_backends_own_list(checkpoint: Path) -> None:
    from rn_backend_oft.constants import CONSTANTS
    from rn_vla.openvla.checkpoint import OpenvlaCheckpoint

    read = OpenvlaCheckpoint.read(checkpoint)
    policy = OftPolicy(
        checkpoint=read, constants=CONSTANTS["bridge"], cameras=1, head="l1", proprio_width=7
    )
    for shard in policy.model(64).shards:
        if shard.path.suffix == ".pt":
            held = {
                name: tuple(value.shape)
                for name, value in torch.load(shard.path, weights_only=True).items()
            }
        else:
            with safe_open(shard.path, framework="pt") as file:
                held = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
        assert held == {name: tuple(weight.shape) for name, weight in shard.weights.items()}

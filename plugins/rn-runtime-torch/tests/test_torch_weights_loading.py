from __future__ import annotations

import dataclasses
import os
import subprocess
import sys

import pytest
import torch
from safetensors.torch import load_file, save_file

from rn_runtime_torch.runtime import TorchRuntime
from rn_runtime_torch.state_dictionary import read_header
from rn_runtime_torch.toy import ToyPolicy
from rn_vla.decoding import Shard, Weight
from roboneuron.errors import CheckpointError

NORM = "language_model.model.norm.weight"
WIDE = "language_model.model.layers.0.mlp.up_proj.weight"


def _shard_with(toy, name):
    return next(shard for shard in toy.model().shards if name in shard.weights)


def _rewrite(toy, change):
    path = _shard_with(toy, NORM).path
    tensors = load_file(path)
    change(tensors)
    save_file(tensors, path)


def test_missing_extra_and_misshaped_tensors_are_all_listed(toy):
    def change(tensors):
        tensors["language_model.extra.weight"] = tensors.pop(NORM)
        tensors[WIDE] = tensors[WIDE][:, :-1].contiguous()

    _rewrite(toy, change)
    with pytest.raises(CheckpointError) as caught:
        TorchRuntime().load(toy.model())
    text = str(caught.value)
    assert f"1 missing: {NORM}" in text
    assert "1 unexpected: language_model.extra.weight" in text
    assert f"{WIDE} is [48, 31], expected [48, 32]" in text


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused_by_name(toy, value):
    _rewrite(toy, lambda tensors: tensors[NORM].__setitem__(3, value))
    with pytest.raises(CheckpointError, match=f"NaN or infinite values in 1 tensors: {NORM}"):
        TorchRuntime().load(toy.model())


@pytest.mark.parametrize("kept", [0, 5, 300, -10])
def test_a_truncated_shard_is_refused_by_name(toy, kept):
    path = _shard_with(toy, NORM).path
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(CheckpointError, match=rf"{path.name} .*truncated or damaged"):
        TorchRuntime().load(toy.model())


def test_an_absent_shard_is_refused_by_name(toy):
    path = _shard_with(toy, NORM).path
    path.unlink()
    with pytest.raises(CheckpointError, match=rf"{path.name} does not exist"):
        TorchRuntime().load(toy.model())


def test_a_pickle_with_code_in_it_is_not_executed(toy, tmp_path):
    import pickle

    class Bomb:
        def __reduce__(self):
            return (sys.exit, (3,))

    (tmp_path / "head.pt").write_bytes(pickle.dumps(Bomb()))
    bad = Shard(path=tmp_path / "head.pt", weights={"x": Weight(shape=(1,), target="")})
    with pytest.raises(CheckpointError, match="truncated or damaged"):
        TorchRuntime().load(dataclasses.replace(toy.model(), shards=(*toy.model().shards, bad)))
    torch.save({"x": Bomb()}, tmp_path / "head.pt")
    with pytest.raises(
        CheckpointError,
        match=r"holds a sys\.exit, expected tensors only; nothing in it was executed",
    ):
        TorchRuntime().load(dataclasses.replace(toy.model(), shards=(*toy.model().shards, bad)))


@pytest.mark.parametrize("kind", [torch.int64, torch.uint8, torch.bool, torch.complex64])
@pytest.mark.parametrize("suffix", ["safetensors", "pt"])
def test_weights_are_real_numbers(toy, tmp_path, kind, suffix):
    shard = _shard_with(toy, NORM)
    tensors = load_file(shard.path)
    tensors[NORM] = tensors[NORM].to(kind)
    path = tmp_path / f"changed.{suffix}"
    (save_file if suffix == "safetensors" else torch.save)(tensors, path)
    others = [
        dataclasses.replace(s, path=path) if s.path == shard.path else s for s in toy.model().shards
    ]
    with pytest.raises(CheckpointError, match=f"1 of a number type that no weight has: {NORM}"):
        TorchRuntime().load(dataclasses.replace(toy.model(), shards=tuple(others)))


def test_a_pipe_instead_of_a_shard_is_refused_and_not_waited_for(toy):
    path = _shard_with(toy, NORM).path
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(CheckpointError, match="not a regular file"):
        TorchRuntime().load(toy.model())


def test_a_state_dictionary_saved_by_torch_is_read_too(toy, tmp_path):
    shards = toy.model().shards
    moved = shards[0]
    path = tmp_path / "moved.pt"
    torch.save(load_file(moved.path), path)
    model = dataclasses.replace(
        toy.model(), shards=(dataclasses.replace(moved, path=path), *shards[1:])
    )
    plain, other = TorchRuntime(), TorchRuntime()
    plain.load(toy.model())
    other.load(model)
    assert (
        other.run(toy.token_request()).tokens.tolist()
        == plain.run(toy.token_request()).tokens.tolist()
    )


def test_a_failed_load_leaves_the_runtime_ready_for_another(toy):
    runtime = TorchRuntime()
    path = _shard_with(toy, NORM).path
    whole = path.read_bytes()
    path.write_bytes(whole[:100])
    with pytest.raises(CheckpointError):
        runtime.load(toy.model())
    path.write_bytes(whole)
    runtime.load(toy.model())


MEASURE = """
import sys, pathlib, resource, torch
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.runtime import TorchRuntime
from rn_runtime_torch.toy import ToyPolicy
from dataclasses import replace
torch.set_num_threads(1)
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
toy = ToyPolicy(path=pathlib.Path(sys.argv[2]))
toy.path.mkdir()
toy.write()
warm = TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32"))
warm.load(toy.model())
warm.run(toy.token_request())
warm.close()
big = ToyPolicy(
    path=pathlib.Path(sys.argv[1]), shards=4,
    shape=replace(toy.shape, hidden=512, intermediate=1536, layers=12, heads=8, key_value_heads=8, vocabulary=8192),
)
before = peak()
runtime = TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="bfloat16"))
runtime.load(big.model())
print(peak() - before)
"""  # noqa: E501


@pytest.mark.exhaustive
def test_loading_needs_no_more_host_memory_than_the_model_and_a_shard(tmp_path, toy):
    """Peak resident memory of a new process, above its initial value, for a bfloat16 model of 80 MB
    in 4 shards.
    """
    shape = dataclasses.replace(
        toy.shape,
        hidden=512,
        intermediate=1536,
        layers=12,
        heads=8,
        key_value_heads=8,
        vocabulary=8192,
    )
    big = ToyPolicy(path=tmp_path / "big", shape=shape, shards=4)
    big.path.mkdir()
    big.write()
    sizes = [shard.path.stat().st_size for shard in big.model().shards]
    run = subprocess.run(
        [sys.executable, "-c", MEASURE, str(big.path), str(tmp_path / "small")],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    slack = 8e6  # allocator, cache and the first run's workspaces
    assert int(run.stdout) <= sum(sizes) + 1.2 * max(sizes) + slack


def test_a_module_saved_by_distributed_training_is_described_as_torch_loads_it(tmp_path):
    module = torch.nn.ModuleDict(
        {"module": torch.nn.Linear(4, 3).to(torch.bfloat16), "norm": torch.nn.LayerNorm(4)}
    )
    state = module.state_dict()
    state["parameter"] = torch.nn.Parameter(torch.zeros(2, 5))
    state["view"] = torch.arange(12.0).view(3, 4).T
    path = tmp_path / "action_head--150000_checkpoint.pt"
    torch.save(state, path)
    loaded = torch.load(path, weights_only=True)
    assert {name: tensor.shape for name, tensor in read_header(path).items()} == {
        name: tuple(tensor.shape) for name, tensor in loaded.items()
    }
    assert read_header(path)["module.weight"].kind == "BFloat16"

"""Tests that need a CUDA device; written for torch 2.11 and newer, skipped without one."""

from __future__ import annotations

import dataclasses
import gc

import numpy as np
import pytest
import torch

from rn_accel_fastv.config import FastVConfig
from rn_accel_fastv.preset import FastV
from rn_backend_oft.constants import CONSTANTS
from rn_backend_oft.policy import OftPolicy
from rn_backend_oft.tiny import make_tiny_oft
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.engine import Engine
from rn_runtime_torch.memory import PeakBytes
from rn_runtime_torch.runtime import TorchRuntime
from rn_runtime_torch.toy import EveryOtherToken
from rn_vla.decoding import PolicyModel, Request, RowsReply
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint
from rn_vla.openvla.policy import policy_model
from rn_vla.openvla.tiny import make_tiny

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]

WARM = (12, 14)
TOLERANCES = {"float32": 1e-4, "bfloat16": 0.05}
"""Kernels of CPU and CUDA, and of other sizes, sum in another order; bfloat16 has 8 bits of
mantissa.
"""


@pytest.fixture(autouse=True)
def _plain_float32():
    """With TF32, the default, convolutions would keep only 10 bits of mantissa."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    yield
    torch.backends.cudnn.allow_tf32 = before


@pytest.fixture(params=["openvla", "oft"])
def model(request, tmp_path) -> PolicyModel:
    """A tiny checkpoint with both vision towers; the other one with two cameras, proprioception and
    the L1 head.
    """
    path = tmp_path / "checkpoint"
    if request.param == "openvla":
        make_tiny(path)
        return policy_model(OpenvlaCheckpoint.read(path), action_width=7, max_prompt_tokens=64)
    make_tiny_oft(path)
    policy = OftPolicy(
        checkpoint=OpenvlaCheckpoint.read(path),
        constants=CONSTANTS["libero"],
        cameras=2,
        head="l1",
        proprio_width=8,
    )
    return policy.model(64)


def _request(model: PolicyModel, length: int, seed: int = 0) -> Request:
    made = model.example(length)
    generator = np.random.default_rng(seed)
    arrays = {
        name: generator.standard_normal(array.shape).astype(np.float32)
        for name, array in made.prompt.arrays.items()
    }
    made = dataclasses.replace(made, prompt=dataclasses.replace(made.prompt, arrays=arrays))
    return made if model.max_new_tokens == 0 else dataclasses.replace(made, with_logits=True)


def _values(engine: Engine, request: Request) -> np.ndarray:
    reply = engine.answer(request, lambda: None)
    return reply.values if isinstance(reply, RowsReply) else reply.logits


def _engine(
    model: PolicyModel,
    device: str = "cuda",
    dtype: str = "float32",
    graphs: bool = True,
    preset=None,
) -> Engine:
    config = TorchRuntimeConfig(
        device=device, dtype=dtype, cuda_graphs=graphs, warm_prompt_tokens=WARM
    )
    return Engine(model, config, preset)


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_graphs_answer_as_the_plain_loop_does(model, dtype, share):
    """Vision front, decoder and L1 head, with FastV and without, at recorded lengths and others,
    several times over.
    """
    presets = [FastV(FastVConfig(k=1, r=share)) if share else None for _ in range(2)]
    recorded, plain = (_engine(model, dtype=dtype, graphs=graphs, preset=preset)
                       for graphs, preset in zip((True, False), presets, strict=True))  # fmt: skip
    for length in (12, 14, 13, 30, 12):
        request = _request(model, length, seed=length)
        got, expected = _values(recorded, request), _values(plain, request)
        scale = max(1.0, float(np.abs(expected).max()))
        # the same kernels on both sides
        np.testing.assert_allclose(got, expected, atol=1e-5 * scale)
        kept = recorded.answer(request, lambda: None).metrics["tokens_kept"]
        assert kept == round(model.visual_tokens * (1.0 - share))


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_cuda_answers_as_the_cpu_does(model, dtype):
    request = _request(model, 13)
    expected = _values(_engine(model, device="cpu"), request)
    got = _values(_engine(model, dtype=dtype), request)
    np.testing.assert_allclose(
        got, expected, atol=TOLERANCES[dtype] * max(1.0, float(np.abs(expected).max()))
    )


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
@pytest.mark.parametrize("model", ["oft"], indirect=True)
def test_a_batch_answers_as_each_alone_does(model, dtype, share):
    engine = _engine(model, dtype=dtype, preset=FastV(FastVConfig(k=1, r=share)) if share else None)
    requests = [_request(model, length, seed=length) for length in (12, 30, 14, 13)]
    replies = engine.answer_batch(requests, lambda: None)
    kept = round(model.visual_tokens * (1.0 - share))
    assert [reply.metrics["tokens_kept"] for reply in replies] == [kept] * 4
    if dtype == "bfloat16" and share:
        return  # near ties may keep other tokens
    for request, reply in zip(requests, replies, strict=True):
        expected = _values(engine, request)
        np.testing.assert_allclose(
            reply.values, expected, atol=TOLERANCES[dtype] * max(1.0, float(np.abs(expected).max()))
        )


def test_outputs_of_one_request_outlive_the_next(model):
    """A replay overwrites the recording's outputs; replies are copies."""
    engine = _engine(model)
    first = _values(engine, _request(model, 12, seed=1))
    kept = first.copy()
    _values(engine, _request(model, 12, seed=2))
    np.testing.assert_array_equal(first, kept)


def test_only_loading_records_and_on_one_stream(model, monkeypatch):
    streams = []
    made = torch.cuda.graph

    def graph(*arguments, stream, **options):
        streams.append(stream)
        return made(*arguments, stream=stream, **options)

    monkeypatch.setattr(torch.cuda, "graph", graph)
    engine = _engine(model)
    for length in (11, 15, 40, 12):
        engine.answer(_request(model, length), lambda: None)
    assert len(engine._graphs) == len(streams) == WARM[1] - WARM[0] + 1
    assert len(set(streams)) == 1


def test_a_selection_works_inside_a_recording(toy):
    engines = [
        _engine(toy.model(), graphs=graphs, preset=EveryOtherToken()) for graphs in (True, False)
    ]
    request = toy.token_request(12)
    tokens = [engine.answer(request, lambda: None).tokens.tolist() for engine in engines]
    assert tokens[0] == tokens[1]


def test_memory_stays_below_what_was_foreseen(model, monkeypatch):
    """Reserved bytes over the whole lifetime of an engine, compared with the estimate of the memory
    check.
    """
    seen = []
    monkeypatch.setattr(
        "rn_runtime_torch.engine.check_fits", lambda needs, device, dtype: seen.append(needs)
    )
    gc.collect()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    engine = _engine(model)
    for length in (12, 14, 40):
        engine.answer(_request(model, length), lambda: None)
    used = torch.cuda.max_memory_allocated() - before
    assert used <= seen[0].total(torch.device("cuda"))


def test_the_foreseen_activations_are_those_of_a_run_on_the_device(model):
    engine = _engine(model, graphs=False)
    request = _request(model, 13)
    engine.answer(request, lambda: None)
    held = [*engine._decoder.parameters(), *engine._front.parameters(), *engine._decoder.buffers()]
    held += [*engine._back.parameters()] if engine._back is not None else []
    held += engine._cache.tensors() if engine._cache is not None else []
    with PeakBytes(held) as peak:
        engine.answer(request, lambda: None)
    assert 0 < peak.peak < torch.cuda.mem_get_info()[0]


def test_close_gives_the_memory_back(model):
    gc.collect()
    torch.cuda.empty_cache()
    before = torch.cuda.memory_allocated()
    runtime = TorchRuntime(TorchRuntimeConfig(device="cuda", warm_prompt_tokens=WARM))
    runtime.load(model)
    runtime.run(_request(model, 12))
    runtime.close()
    gc.collect()
    left = torch.cuda.memory_allocated() - before
    assert left <= 256 * 2**20  # workspaces of cuBLAS belong to the process

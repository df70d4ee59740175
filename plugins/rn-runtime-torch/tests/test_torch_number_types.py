from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from rn_runtime_torch import device as device_module
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.device import choose_dtype
from rn_runtime_torch.engine import Engine
from rn_runtime_torch.int8 import Int8Weight, check_int8
from rn_runtime_torch.runtime import TorchRuntime
from roboneuron.errors import ConfigurationError


@pytest.mark.parametrize(("tiles", "dtype"), [(True, torch.bfloat16), (False, torch.float32)])
def test_auto_is_bfloat16_where_the_processor_multiplies_it_in_tiles(monkeypatch, tiles, dtype):
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: tiles)
    assert choose_dtype(TorchRuntimeConfig(device="cpu"), torch.device("cpu")) is dtype
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    assert not device_module.has_matrix_tiles()


def test_a_named_type_is_taken_whatever_the_processor():
    assert choose_dtype(TorchRuntimeConfig(dtype="float32"), torch.device("cpu")) is torch.float32


def test_int8_products_differ_from_the_original_by_the_rounding_alone():
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn(2100, 512, generator=generator)
    weight[7] = 0  # a row without a scale
    row = torch.randn(1, 512, generator=generator)
    held = Int8Weight(weight)
    got, exact = held.times(row), row @ weight.t()
    # Rounding to 127 steps of a row's largest value, about 3.5 sigma: 0.8 %; bfloat16 in and out
    # adds 0.3 %.
    assert (got - exact).norm() / exact.norm() < 0.015
    assert got.dtype is torch.float32
    assert got[0, 7] == 0


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_int8_changes_decoding_and_not_the_prompt(toy, dtype):
    plain, quantized = (
        TorchRuntime(TorchRuntimeConfig(device="cpu", dtype=dtype, decode_weights=weights))
        for weights in ("same", "int8")
    )
    plain.load(toy.model())
    quantized.load(toy.model())
    request = toy.token_request()
    np.testing.assert_array_equal(quantized.run(request).logits, plain.run(request).logits)
    assert quantized.run(request).tokens[0] == plain.run(request).tokens[0]
    assert all(layer.int8 for layer in quantized._engine._decoder.layers)


def test_int8_is_refused_where_it_has_no_kernel():
    with pytest.raises(ConfigurationError, match="no kernel on cuda"):
        check_int8(torch.device("cuda"))


class _Copies(TorchDispatchMode):
    """Sizes of what operators allocate."""

    def __init__(self) -> None:
        super().__init__()
        self.largest = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        shares = isinstance(result, torch.Tensor) and any(
            isinstance(a, torch.Tensor)
            and a.untyped_storage().data_ptr() == result.untyped_storage().data_ptr()
            for a in (*args, *(kwargs or {}).values())
        )
        if isinstance(result, torch.Tensor) and not shares:
            self.largest = max(self.largest, result.nbytes)
        return result


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_no_pass_copies_the_output_head(toy, dtype):
    """A product with a three-dimensional slice used to copy the whole head: 2.6 s of each request
    at real size in bfloat16.
    """
    engine = Engine(toy.model(), TorchRuntimeConfig(device="cpu", dtype=dtype), None)
    hidden = torch.randn(1, 9, toy.shape.hidden).to(engine._dtype)[:, -1:]
    assert not hidden.is_contiguous() or hidden.stride(0) != toy.shape.hidden
    with torch.inference_mode(), _Copies() as copies:
        engine._decoder.logits(hidden)
    assert copies.largest <= toy.shape.vocabulary * 4


def test_a_second_pass_allocates_nothing_large(toy):
    """Large intermediates are in buffers of the engine; only normed rows of the residual stream's
    size remain.
    """
    engine = Engine(toy.model(), TorchRuntimeConfig(device="cpu", dtype="float32"), None)
    request, shape = toy.token_request(40), toy.shape
    engine.answer(request, lambda: None)
    hidden = torch.randn(1, 56, shape.hidden)
    with torch.inference_mode(), _Copies() as copies:
        engine._decoder(hidden, causal=True, cache=engine._cache, last=1)
    assert copies.largest <= 56 * shape.hidden * 4


@pytest.mark.parametrize("causal", [True, False])
@pytest.mark.parametrize("last", [1, 5])
def test_reading_the_last_rows_gives_those_of_a_whole_pass(toy, causal, last):
    engine = Engine(toy.model(), TorchRuntimeConfig(device="cpu", dtype="float32"), None)
    hidden = torch.randn(1, 40, toy.shape.hidden, generator=torch.Generator().manual_seed(1))
    before = hidden.clone()
    with torch.inference_mode():
        whole = engine._decoder(hidden, causal=causal).clone()
        some = engine._decoder(hidden, causal=causal, last=last)
    # other sizes, other order of sums
    torch.testing.assert_close(some, whole[:, -last:], atol=1e-5, rtol=1e-5)
    assert torch.equal(hidden, before)

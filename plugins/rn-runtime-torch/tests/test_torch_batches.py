"""Requests answered together: same results as alone, in as few passes as memory allows."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest
import torch

from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.fillings import fill_up
from rn_runtime_torch.runtime import TorchRuntime
from rn_runtime_torch.toy import EveryOtherToken
from rn_vla.decoding import BatchRuntime
from roboneuron.errors import InvalidInputError, NotReadyError, PluginError, StateError, UnsafeError

LENGTHS = (9, 8, 40, 9, 12, 30, 8, 17)
"""Lengths of the prompts; toy prompts include their four read rows and two after them."""


class ByLength:
    """Drops as many positions as the sequence has, modulo 3."""

    layer = 1

    def apply(self, decoder):
        decoder.install_selection(self)

    def select(self, view):
        count = view.key.shape[2]
        dropped = count % 3
        return torch.cat((torch.arange(1), torch.arange(1 + dropped, count)))


@pytest.fixture
def requests(toy):
    return [toy.rows_request(length, seed=seed) for seed, length in enumerate(LENGTHS)]


def loaded(toy, acceleration=None) -> TorchRuntime:
    made = TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32"))
    made.load(toy.model("openvla-oft"), acceleration)
    return made


def test_the_runtime_answers_batches(toy):
    assert isinstance(loaded(toy), BatchRuntime)


@pytest.mark.parametrize("acceleration", [None, EveryOtherToken()], ids=["all", "every-other"])
@pytest.mark.parametrize("count", range(1, 9))
def test_each_reply_of_a_batch_is_the_reply_alone(toy, requests, acceleration, count):
    runtime = loaded(toy, acceleration)
    for request, reply in zip(requests, runtime.run_batch(requests[:count]), strict=False):
        alone = runtime.run(request)
        np.testing.assert_allclose(reply.values, alone.values, rtol=0, atol=1e-5)
        assert reply.values.shape == (4, 32)
        assert reply.metrics["tokens_kept"] == alone.metrics["tokens_kept"]


def test_batches_leave_what_follows_as_it_was(toy, requests):
    runtime = loaded(toy)
    before = runtime.run(requests[0]).values
    runtime.run_batch(requests)
    np.testing.assert_array_equal(runtime.run(requests[0]).values, before)


def test_best_ids_are_read_for_each(toy, requests):
    runtime = loaded(toy)
    wanted = [dataclasses.replace(request, read="tokens") for request in requests]
    for request, reply in zip(wanted, runtime.run_batch(wanted), strict=True):
        np.testing.assert_array_equal(reply.values, runtime.run(request).values)


def test_more_than_fit_in_memory_become_several_passes(toy, requests):
    runtime = loaded(toy)
    runtime._engine._most = 3
    replies = runtime.run_batch(requests)
    assert [reply.metrics["batch"] for reply in replies] == [3.0] * 6 + [2.0] * 2
    for request, reply in zip(requests, replies, strict=True):
        np.testing.assert_allclose(reply.values, runtime.run(request).values, rtol=0, atol=1e-5)


def test_the_memory_that_is_free_bounds_a_pass(toy, monkeypatch):
    monkeypatch.setattr("rn_runtime_torch.engine.free_bytes", lambda device: 10**9)
    monkeypatch.setattr("rn_runtime_torch.device.free_bytes", lambda device: 10**9)
    engine = loaded(toy)._engine
    assert engine._most == 10**9 // 2 // engine._activations


def test_a_selection_that_keeps_unequally_many_is_refused(toy, requests):
    with pytest.raises(PluginError, match="ByLength keeps"):
        loaded(toy, ByLength()).run_batch(requests)


def test_requests_that_do_not_read_alike_are_refused(toy, requests):
    runtime = loaded(toy)
    with pytest.raises(InvalidInputError, match="same rows"):
        runtime.run_batch([requests[0], dataclasses.replace(requests[1], tail=1)])
    with pytest.raises(InvalidInputError, match="same rows"):
        runtime.run_batch([])
    with pytest.raises(InvalidInputError, match="RowsRequest"):
        runtime.run_batch([requests[0], toy.token_request()])
    with pytest.raises(InvalidInputError, match="at most 64"):
        runtime.run_batch([requests[0], toy.rows_request(65)])


def test_a_deadline_of_one_is_that_of_all(toy, requests):
    runtime = loaded(toy)
    late = dataclasses.replace(requests[1], deadline_s=time.monotonic() - 0.01)
    with pytest.raises(NotReadyError, match="deadline"):
        runtime.run_batch([requests[0], late])


def test_a_value_that_is_not_finite_is_refused(toy, requests):
    arrays = {"features": np.full_like(requests[1].prompt.arrays["features"], np.nan)}
    broken = dataclasses.replace(
        requests[1], prompt=dataclasses.replace(requests[1].prompt, arrays=arrays)
    )
    with pytest.raises(UnsafeError, match="NaN"):
        loaded(toy).run_batch([requests[0], broken])


def test_a_batch_needs_a_model(requests):
    with pytest.raises(StateError):
        TorchRuntime(TorchRuntimeConfig(device="cpu")).run_batch(requests)


def test_prompts_are_filled_up_behind_their_first_id():
    ids, counts = fill_up([np.array([1, 5, 6, 7]), np.array([2, 9])])
    assert ids.tolist() == [[1, 5, 6, 7], [2, 2, 2, 9]]
    assert counts == (0, 2)

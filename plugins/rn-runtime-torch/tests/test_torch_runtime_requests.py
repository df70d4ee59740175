from __future__ import annotations

import dataclasses
import threading
import time

import numpy as np
import pytest
import torch

from rn_runtime_torch import device as device_module
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.runtime import TorchRuntime
from roboneuron.errors import (
    ConfigurationError,
    InvalidInputError,
    NotReadyError,
    StateError,
    UnsafeError,
)


@pytest.fixture
def runtime(toy) -> TorchRuntime:
    made = TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32"))
    made.load(toy.model())
    return made


def test_cached_decoding_gives_the_tokens_of_full_passes(toy, runtime):
    """Each next token equals the first decoded token of a request with the previous tokens as
    prompt.
    """
    request = toy.token_request()
    tokens = runtime.run(request).tokens
    for count in range(1, 7):
        ids = np.concatenate([request.prompt.ids, tokens[:count]])
        longer = dataclasses.replace(
            request, prompt=dataclasses.replace(request.prompt, ids=ids), max_new_tokens=1
        )
        assert runtime.run(longer).tokens[0] == tokens[count]


def test_prefill_is_causal_so_logits_do_not_depend_on_later_requests(toy, runtime):
    request = toy.token_request()
    one = runtime.run(dataclasses.replace(request, max_new_tokens=1)).logits
    seven = runtime.run(request).logits
    np.testing.assert_array_equal(one, seven)


def test_requests_of_different_lengths_do_not_disturb_each_other(toy, runtime):
    before = runtime.run(toy.token_request(9)).tokens.tolist()
    runtime.run(toy.token_request(40, seed=2))
    assert runtime.run(toy.token_request(9)).tokens.tolist() == before


def test_transformers_decodes_the_same_tokens_from_the_same_weights(toy, runtime):
    transformers = pytest.importorskip("transformers")
    shape = toy.shape
    config = transformers.LlamaConfig(
        hidden_size=shape.hidden,
        intermediate_size=shape.intermediate,
        num_hidden_layers=shape.layers,
        num_attention_heads=shape.heads,
        num_key_value_heads=shape.key_value_heads,
        vocab_size=shape.vocabulary,
        rms_norm_eps=shape.norm_epsilon,
        max_position_embeddings=shape.max_positions,
        attn_implementation="eager",
    )
    model = transformers.LlamaForCausalLM(config).eval()
    engine = runtime._engine
    model.load_state_dict({name: slot.clone() for name, slot in engine._decoder.slots().items()})
    request = toy.token_request()
    inputs = {"features": torch.from_numpy(request.prompt.arrays["features"])[None]}
    with torch.inference_mode():
        hidden = engine._front(
            inputs, torch.from_numpy(request.prompt.ids)[None], engine._decoder.embed
        )
        logits = model(inputs_embeds=hidden).logits[0, -1].numpy()
    # float32, fused projections
    np.testing.assert_allclose(runtime.run(request).logits, logits, atol=1e-5)


def test_a_passed_deadline_gives_up(toy, runtime):
    request = dataclasses.replace(toy.token_request(), deadline_s=time.monotonic() - 0.01)
    with pytest.raises(NotReadyError, match="deadline"):
        runtime.run(request)


def test_abort_from_another_thread_ends_the_run_in_progress(toy, runtime):
    started = threading.Event()
    front = runtime._engine._passes._front

    def slow_front(*arguments):
        started.set()
        assert released.wait(5)
        return front(*arguments)

    released = threading.Event()
    runtime._engine._passes._front = slow_front
    errors: list[BaseException] = []

    def work() -> None:
        try:
            runtime.run(toy.token_request())
        except NotReadyError as error:
            errors.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    assert started.wait(5)
    runtime.abort()
    released.set()
    thread.join(5)
    assert "abort" in str(errors[0])
    runtime._engine._passes._front = front
    assert runtime.run(toy.token_request()).tokens.shape == (7,)


def test_nan_inside_the_model_is_unsafe_and_not_an_answer(toy, runtime):
    runtime._engine._decoder.layers[1].norm_in.data.fill_(torch.nan)
    with pytest.raises(UnsafeError, match="NaN"):
        runtime.run(toy.token_request())


def test_a_second_load_needs_a_close_first(toy, runtime):
    with pytest.raises(StateError, match="close"):
        runtime.load(toy.model())
    runtime.close()
    runtime.load(toy.model())


def test_more_tokens_than_loaded_for_are_refused(toy, runtime):
    with pytest.raises(InvalidInputError, match="8 tokens"):
        runtime.run(dataclasses.replace(toy.token_request(), max_new_tokens=8))


def test_a_model_of_another_family_is_refused(toy):
    model = dataclasses.replace(toy.model(), family="pi0")
    with pytest.raises(InvalidInputError, match="openvla"):
        TorchRuntime().load(model)


def test_prompts_that_no_position_is_left_for_are_refused(toy):
    model = dataclasses.replace(toy.model(), max_prompt_tokens=400)
    with pytest.raises(ConfigurationError, match="423 positions"):
        TorchRuntime().load(model)


def test_a_model_larger_than_free_memory_is_refused_before_reading(toy, monkeypatch):
    monkeypatch.setattr(device_module, "free_bytes", lambda device: 1000)
    with pytest.raises(ConfigurationError, match=r"needs .* GB as float32 on cpu"):
        TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32")).load(toy.model())


def test_running_out_of_memory_is_reported_with_what_to_do(toy, runtime):
    def exhausted(*arguments):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB.\nmore")

    runtime._engine._passes._front = exhausted
    with pytest.raises(ConfigurationError, match=r"Out of memory on cpu.*smaller dtype"):
        runtime.run(toy.token_request())


def test_a_cuda_device_that_is_not_there_is_refused(toy, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigurationError, match=r"sees 0 CUDA devices"):
        TorchRuntime(TorchRuntimeConfig(device="cuda:1")).load(toy.model())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler warns about torch
def test_compiled_layers_give_the_same_tokens(toy, runtime):
    compiled = TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32", compile=True))
    compiled.load(toy.model())
    assert (
        compiled.run(toy.token_request()).tokens.tolist()
        == runtime.run(toy.token_request()).tokens.tolist()
    )


@pytest.mark.parametrize("ids", [[1, 96, 2], [1, -1, 2], [1, 2**40, 2], []])
def test_an_id_without_an_embedding_is_refused_before_it_is_looked_up(toy, runtime, ids):
    request = toy.token_request()
    prompt = dataclasses.replace(request.prompt, ids=np.array(ids, dtype=np.int64))
    with pytest.raises(InvalidInputError, match="expected some from 0 to 95"):
        runtime.run(dataclasses.replace(request, prompt=prompt))

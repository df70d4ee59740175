"""Comparison with the public modelling code in float32; see tests/data/README.md."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.decoder import Decoder
from rn_runtime_torch.runtime import TorchRuntime
from rn_vla.openvla.policy import action_bins, policy_model, token_request
from rn_vla.openvla.preprocessing import Preprocessor
from rn_vla.openvla.prompt import end_prompt
from rn_vla.openvla.statistics import Scaling, choose_statistics

LOGIT_TOLERANCE = 1e-4
"""Fused projections and SDPA sum in another order; 4e-6 was measured."""
INT8_TOLERANCE = {"float32": 0.01, "bfloat16": 0.03}
"""Fraction of the largest logit. Products with int8 weights convert their rows to bfloat16, which
rounds by 2^-9, and so do outputs in bfloat16; 0.0017 and 0.0095 were measured with AVX-512, AVX2
and SSE4.1 kernels.
"""


def _request(golden, pixel_values=None):
    request = token_request(
        text="",
        ids=end_prompt(golden["input_ids"][0]),
        image=golden["image_0"],
        pixel_values=golden["pixel_values"][0] if pixel_values is None else pixel_values,
        action_width=7,
    )
    return dataclasses.replace(request, with_logits=True)


def test_pixels_equal_those_of_the_original_processor(golden, golden_checkpoint):
    preprocessor = Preprocessor(size=224, towers=golden_checkpoint.towers)
    pixels = preprocessor.to_pixels(golden["image_0"])
    np.testing.assert_allclose(pixels, golden["pixel_values"][0], atol=1e-6)


def test_prefill_logits_are_those_of_the_original_model(golden, golden_runtime):
    reply = golden_runtime.run(_request(golden))
    np.testing.assert_allclose(reply.logits, golden["prefill_logits"], atol=LOGIT_TOLERANCE)


def test_all_seven_greedy_tokens_are_those_of_the_original_model(golden, golden_runtime):
    assert golden_runtime.run(_request(golden)).tokens.tolist() == golden["tokens"].tolist()


def test_a_second_request_starts_from_a_clean_cache(golden, golden_runtime):
    first = golden_runtime.run(_request(golden)).tokens
    golden_runtime.run(_request(golden, pixel_values=-golden["pixel_values"][0]))
    assert golden_runtime.run(_request(golden)).tokens.tolist() == first.tolist()


def test_tokens_become_the_action_of_the_original(golden, golden_checkpoint):
    _, statistics = choose_statistics(golden_checkpoint.statistics, "toy_suite", "config.json")
    values = action_bins(golden_checkpoint).to_values(golden["tokens"])
    action = Scaling.of(statistics.action, "q99", 0.0).to_units(values)
    np.testing.assert_allclose(action, golden["action"], atol=1e-12)  # float64 on both sides


def test_leaving_out_the_final_token_changes_the_logits(golden, golden_runtime):
    request = _request(golden)
    short = dataclasses.replace(
        request, prompt=dataclasses.replace(request.prompt, ids=golden["input_ids"][0])
    )
    assert np.abs(golden_runtime.run(short).logits - golden["prefill_logits"]).max() > 0.1


@pytest.mark.parametrize("dtype", ["bfloat16", "float16"])
def test_half_precision_stays_near_the_float32_logits(golden, golden_checkpoint, dtype):
    runtime = TorchRuntime(TorchRuntimeConfig(dtype=dtype))
    runtime.load(policy_model(golden_checkpoint, action_width=7, max_prompt_tokens=64))
    logits = runtime.run(_request(golden)).logits
    scale = np.abs(golden["prefill_logits"]).max()
    # 8 bits of mantissa through 8 layers
    assert np.abs(logits - golden["prefill_logits"]).max() < 0.05 * scale


@pytest.mark.parametrize("dtype", INT8_TOLERANCE)
def test_decoding_with_int8_weights_stays_near_the_logits(
    golden, golden_checkpoint, monkeypatch, dtype
):
    """Compare every step with the same preceding tokens: rounding decides between two nearly equal
    tokens.
    """
    steps = {}
    for weights in ("same", "int8"):
        runtime = TorchRuntime(
            TorchRuntimeConfig(device="cpu", dtype=dtype, decode_weights=weights)
        )
        runtime.load(policy_model(golden_checkpoint, action_width=7, max_prompt_tokens=64))
        steps[weights] = _logits_of_each_step(runtime, _request(golden), monkeypatch)
    compared = 0
    for same, int8 in zip(steps["same"], steps["int8"], strict=True):
        assert np.abs(int8 - same).max() < INT8_TOLERANCE[dtype] * np.abs(same).max()
        compared += 1
        if same.argmax() != int8.argmax():
            break
    assert compared >= 2  # the first is read from the prompt, with the original weights


def _logits_of_each_step(runtime, request, monkeypatch):
    """The seven logits (vocabulary,) from which a request's tokens were chosen."""
    recorded = []
    logits = Decoder.logits

    def record(self, hidden):
        answer = logits(self, hidden)
        recorded.append(answer[0, -1].numpy().copy())
        return answer

    with monkeypatch.context() as patched:
        patched.setattr(Decoder, "logits", record)
        tokens = runtime.run(request).tokens
    assert [int(step.argmax()) for step in recorded[-7:]] == tokens.tolist()
    return recorded[-7:]

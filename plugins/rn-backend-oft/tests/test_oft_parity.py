"""Comparison with the public modelling code in float32; see tests/data/README.md."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from safetensors import safe_open

from rn_backend_oft.constants import CONSTANTS
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.runtime import TorchRuntime
from rn_vla.openvla.policy import action_bins
from rn_vla.openvla.preprocessing import Preprocessor
from rn_vla.openvla.prompt import end_prompt
from rn_vla.openvla.statistics import Scaling, choose_statistics

EPSILON = 1e-8


def _request(policy, golden, read=None, **changes):
    given = {
        "ids": end_prompt(golden["input_ids"][0]),
        "pixel_values": golden["pixel_values"][0],
        "proprio": golden["proprio_normalized"].astype(np.float32),
    } | changes
    return policy.request(
        text="", images=(golden["image_0"], golden["image_1"]), read=read, **given
    )


def _statistics(policy):
    return choose_statistics(policy.checkpoint.statistics, "toy_suite", "")[1]


def test_pixels_of_both_cameras_equal_those_of_the_original_processor(golden, golden_policy):
    preprocessor = Preprocessor(size=224, towers=golden_policy.checkpoint.towers)
    pixels = np.concatenate(
        [preprocessor.to_pixels(golden[name]) for name in ("image_0", "image_1")]
    )
    np.testing.assert_allclose(pixels, golden["pixel_values"][0], atol=1e-6)


def test_proprioception_is_normalised_as_in_the_original(golden, golden_policy):
    scaling = Scaling.of(_statistics(golden_policy).proprio, "q99", EPSILON)
    np.testing.assert_allclose(
        scaling.to_normalized(golden["proprio_raw"]), golden["proprio_normalized"], atol=1e-6
    )  # the original keeps parts of it in float32


def test_action_rows_are_those_of_the_original_model(golden, golden_policy, golden_runtime):
    rows = golden_runtime.run(_request(golden_policy, golden, "hidden")).values
    np.testing.assert_allclose(rows, golden["action_hidden"][0], atol=1e-4)


def test_the_chunk_is_that_of_the_original_model(golden, golden_policy, golden_runtime):
    values = golden_runtime.run(_request(golden_policy, golden)).values.astype(np.float64)
    actions = Scaling.of(_statistics(golden_policy).action, "q99", EPSILON).to_units(values)
    np.testing.assert_allclose(actions, golden["action_chunk"], atol=1e-5)


def test_attention_is_bidirectional_so_a_late_token_changes_the_first_row(
    golden, golden_policy, golden_runtime
):
    request = _request(golden_policy, golden, "hidden")
    ids = request.prompt.ids.copy()
    ids[-1] = 700  # in place of the stop token, after every row that is read
    other = dataclasses.replace(request, prompt=dataclasses.replace(request.prompt, ids=ids))
    difference = golden_runtime.run(request).values[0] - golden_runtime.run(other).values[0]
    assert np.abs(difference).max() > 1e-3


def test_the_wrist_image_and_the_state_both_count(golden, golden_policy, golden_runtime):
    whole = golden_runtime.run(_request(golden_policy, golden)).values
    pixels = golden["pixel_values"][0].copy()
    pixels[6:] = 0
    blind = golden_runtime.run(_request(golden_policy, golden, pixel_values=pixels)).values
    numb = golden_runtime.run(
        _request(golden_policy, golden, proprio=np.zeros(8, dtype=np.float32))
    ).values
    assert np.abs(whole - blind).max() > 1e-4
    assert np.abs(whole - numb).max() > 1e-4


def test_rows_read_as_tokens_are_the_best_ids_of_the_output_head(
    golden, golden_policy, golden_runtime
):
    rows = golden_runtime.run(_request(golden_policy, golden, "hidden")).values
    tokens = golden_runtime.run(_request(golden_policy, golden, "tokens")).values
    with safe_open(golden_policy.checkpoint.path / "model.safetensors", "pt") as file:
        head = file.get_tensor("language_model.lm_head.weight").to(torch.float32).numpy()
    assert tokens.tolist() == (rows @ head.T).argmax(axis=1).tolist()
    assert action_bins(golden_policy.checkpoint).to_values(tokens.astype(np.int64)).shape == (56,)


def test_a_policy_without_head_and_proprio_runs_on_the_base_weights(
    golden, golden_policy, golden_copy
):
    for file in golden_copy.glob("*_checkpoint.pt"):
        file.unlink()
    checkpoint = type(golden_policy.checkpoint).read(golden_copy)
    policy = dataclasses.replace(
        golden_policy, checkpoint=checkpoint, head="tokens", proprio_width=0
    )
    runtime = TorchRuntime(TorchRuntimeConfig(dtype="float32"))
    runtime.load(policy.model(64))
    values = runtime.run(_request(policy, golden, proprio=None)).values
    assert values.shape == (CONSTANTS["libero"].tokens,)

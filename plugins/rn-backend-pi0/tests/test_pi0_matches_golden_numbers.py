"""Parity with openpi's and LeRobot's own code; data/pi0-tiny/README.md describes the origin of the
numbers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from rn_backend_pi0.image import resize_plain, to_pixels
from rn_backend_pi0.layouts import read_checkpoint
from rn_backend_pi0.model import Pi0Model, flow_times
from rn_vla.letterbox import fit_antialiased

Arrays = dict[str, np.ndarray]
# Case: camera slots (base, left wrist, right wrist), prompt, state, noise.
CASES = {
    "main": (("base", "wrist", None), "", "", ""),
    "masked_wrist": (("base", None, None), "", "", ""),
    "masked_base": ((None, "wrist", None), "", "", ""),
    "three_cameras": (("base", "wrist", "third"), "", "", ""),
    "other_image": (("base_alt", "wrist", None), "", "", ""),
    "other_prompt": (("base", "wrist", None), "_alt", "", ""),
    "other_state": (("base", "wrist", None), "", "_alt", ""),
    "other_noise": (("base", "wrist", None), "", "", "_alt"),
}


@pytest.fixture(scope="module", params=["lerobot", "openpi"])
def model(request: pytest.FixtureRequest, golden_directory: Path) -> Pi0Model:
    """The golden weights, with the arithmetic of one of the two implementations."""
    checkpoint = read_checkpoint(golden_directory)
    return Pi0Model(
        checkpoint, device="cpu", dtype="float32", numerics=request.param, cpu_threads=1
    )


def _run(model: Pi0Model, golden: Arrays, case: str) -> np.ndarray:
    cameras, prompt, state, noise = CASES[case]
    images = [None if name is None else golden[f"in/image_{name}"] for name in cameras]
    tokens = golden[f"in/prompt{prompt}_tokens"][golden[f"in/prompt{prompt}_mask"]]
    return model.infer(
        images, tokens.tolist(), golden[f"in/state{state}_raw"], golden[f"in/noise{noise}"][0]
    )


@pytest.mark.parametrize("case", CASES)
def test_actions_are_within_2e_5_of_the_code_that_is_followed(
    model: Pi0Model, golden: Arrays, case: str
) -> None:
    # From images and the raw state; 2e-5 is float32 rounding, most mistakes cause 1e-2 and more
    # (golden README).
    family = "openpi" if model.state.forward_eps == pytest.approx(1e-6) else "lerobot"
    normalized = _run(model, golden, case)
    np.testing.assert_allclose(
        normalized, golden[f"out/{case}/actions_norm_{family}"], atol=2e-5, rtol=0
    )
    actions = model.action.denormalize(normalized[:, :7])
    np.testing.assert_allclose(actions, golden[f"out/{case}/actions_{family}"], atol=2e-5, rtol=0)


@pytest.mark.parametrize("family", ["lerobot", "openpi"])
def test_flow_times_are_those_of_the_original_code_bit_by_bit(golden: Arrays, family: str) -> None:
    assert flow_times(family, 10) == tuple(golden[f"trace/t_{family}"].astype(np.float32).tolist())  # type: ignore[arg-type]


def test_the_normalised_state_is_that_of_the_code_that_is_followed(
    model: Pi0Model, golden: Arrays
) -> None:
    family = "openpi" if model.state.forward_eps == pytest.approx(1e-6) else "lerobot"
    expected = golden[f"in/state_model_{family}"][:8]
    np.testing.assert_allclose(
        model.state.normalize(golden["in/state_raw"]), expected, atol=1e-6, rtol=0
    )


def test_both_layouts_hold_the_same_statistics(golden_directory: Path, tmp_path: Path) -> None:
    from rn_vla.normalisation import read_openpi_scalings

    theirs, _ = read_openpi_scalings(golden_directory / "norm_stats.json", "mean_std")
    ours = read_checkpoint(golden_directory).state
    np.testing.assert_array_equal(theirs.mean, ours.mean)
    np.testing.assert_array_equal(theirs.std, ours.std)


def test_pixels_are_scaled_to_minus_one_to_one(golden: Arrays) -> None:
    for name in ("base", "wrist"):
        pixels = to_pixels(golden[f"in/image_{name}"], side=224, resize="plain", flip="none")
        np.testing.assert_allclose(pixels, golden[f"in/pixels_{name}"], atol=1e-6, rtol=0)


@pytest.mark.parametrize("suffix", ["", "_big"])
def test_antialiased_resizing_is_that_of_openpis_client(golden: Arrays, suffix: str) -> None:
    resized = fit_antialiased(golden[f"resize/input{suffix}"], (224, 224))
    np.testing.assert_array_equal(resized, golden[f"resize/openpi_client_pil{suffix}"])


@pytest.mark.parametrize("suffix", ["", "_big"])
def test_plain_resizing_is_that_of_lerobot(golden: Arrays, suffix: str) -> None:
    resized = resize_plain(golden[f"resize/input{suffix}"], 224) / 127.5 - 1.0
    # Float rounding of the sampling positions; one grey level would be 7.8e-3.
    np.testing.assert_allclose(resized, golden[f"resize/lerobot_torch{suffix}"], atol=2e-5, rtol=0)


def test_plain_resizing_when_enlarging_is_that_of_openpis_torch_code(golden: Arrays) -> None:
    resized = resize_plain(golden["resize/input"], 224) / 127.5 - 1.0
    np.testing.assert_allclose(resized, golden["resize/openpi_torch"], atol=2 / 255, rtol=0)


def test_the_native_resize_error_is_far_below_one_grey_level(golden: Arrays) -> None:
    pixels = to_pixels(golden["resize/input_big"], side=224, resize="antialiased", flip="none")
    expected = golden["resize/openpi_client_pil_big"].transpose(2, 0, 1) / 127.5 - 1.0
    assert np.abs(pixels - expected).max() < 1 / 255


def test_a_missing_camera_is_the_same_as_no_camera(golden_directory: Path, golden: Arrays) -> None:
    model = Pi0Model(
        read_checkpoint(golden_directory), device="cpu", dtype="float32", cpu_threads=1
    )
    state, noise = golden["in/state_raw"], golden["in/noise"][0]
    tokens = golden["in/prompt_tokens"][golden["in/prompt_mask"]].tolist()
    images = [golden["in/image_base"]]
    one = model.infer(images, tokens, state, noise)
    np.testing.assert_array_equal(one, model.infer([*images, None, None], tokens, state, noise))


def test_bfloat16_stays_near_float32(golden_directory: Path, golden: Arrays) -> None:
    checkpoint = read_checkpoint(golden_directory)
    narrow = Pi0Model(checkpoint, device="cpu", dtype="bfloat16", cpu_threads=1)
    error = np.abs(_run(narrow, golden, "main") - golden["out/main/actions_norm_lerobot"])
    # bfloat16 has 8 bits of mantissa: about 0.4 % per operation on values around 1.
    assert 0 < error.mean() < 0.05


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_gpu_in_float32_gives_the_golden_actions(golden_directory: Path, golden: Arrays) -> None:
    model = Pi0Model(read_checkpoint(golden_directory), device="cuda", dtype="float32")
    for case in CASES:
        # Other kernels sum in another order; TF32 is off by default.
        expected = golden[f"out/{case}/actions_norm_lerobot"]
        np.testing.assert_allclose(_run(model, golden, case), expected, atol=2e-4, rtol=0)
    model.release()

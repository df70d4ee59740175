"""The native backend: inputs affect the answer, noise is repeatable, missing or non-finite values
are refused.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rn_backend_pi0.in_process import resolve_slots
from rn_backend_pi0.native import Pi0Backend
from rn_backend_pi0.options import Pi0Options
from roboneuron.contract import JointSample, Observation
from roboneuron.errors import (
    CheckpointError,
    ConfigurationError,
    StateError,
    UngroundedError,
    UnsafeError,
)

Observe = Callable[..., Observation]


def _backend(checkpoint: Path, **options: Any) -> Pi0Backend:
    backend = Pi0Backend(Pi0Options(checkpoint=checkpoint, device="cpu", cpu_threads=1, **options))
    backend.load()
    return backend


@pytest.fixture(scope="module")
def loaded(tiny_checkpoint: Path) -> Iterator[Pi0Backend]:
    """A tiny backend with the same noise in every inference."""
    backend = _backend(tiny_checkpoint, noise="fixed", seed=3)
    yield backend
    backend.close()


@pytest.mark.parametrize(
    "change",
    [
        {"primary": 255},
        {"wrist": 0},
        {"instruction": "open the drawer"},
        {"position_m": (0.5, 0.1, 0.3)},
        {"gripper_open": 0.0},
    ],
    ids=["white image", "wrist image", "instruction", "pose", "gripper"],
)
def test_each_input_changes_the_actions(
    loaded: Pi0Backend, observe: Observe, change: dict[str, Any]
) -> None:
    before = loaded.predict(observe(primary=0)).actions
    after = loaded.predict(observe(**{"primary": 0, **change})).actions
    assert np.abs(before - after).max() > 1e-5  # repeated runs are bit-identical, see the next test


def test_the_same_observation_and_noise_repeat_bit_by_bit(
    loaded: Pi0Backend, observe: Observe
) -> None:
    np.testing.assert_array_equal(
        loaded.predict(observe()).actions, loaded.predict(observe()).actions
    )


def test_a_seeded_episode_repeats_after_reset_with_fresh_noise_inside(
    tiny_checkpoint: Path, observe: Observe
) -> None:
    backend = _backend(tiny_checkpoint, seed=5)
    first, second = backend.predict(observe()).actions, backend.predict(observe()).actions
    backend.reset()
    np.testing.assert_array_equal(backend.predict(observe()).actions, first)
    np.testing.assert_array_equal(backend.predict(observe()).actions, second)
    assert np.abs(first - second).max() > 1e-3
    backend.close()


def test_a_chunk_says_what_it_cost_and_how_far_the_state_is_from_training(
    loaded: Pi0Backend, observe: Observe
) -> None:
    chunk = loaded.predict(observe(wrist=10))
    assert chunk.actions.shape == (10, 7)
    assert chunk.step_s == 0.05
    assert chunk.note == ""
    assert {"inference_ms", "chunk_horizon", "cameras", "prompt_tokens", "state_deviation"} == set(
        chunk.metrics
    )
    assert chunk.metrics["cameras"] == 2
    far = loaded.predict(observe(position_m=(20.0, 0.0, 0.5)))
    assert "standard deviations" in far.note


def test_images_of_any_size_are_fitted(loaded: Pi0Backend, observe: Observe) -> None:
    for size in ((1, 1), (1, 2000), (480, 640), (224, 224)):
        assert np.isfinite(loaded.predict(observe(size=size)).actions).all()


def test_the_openpi_layout_loads_too(tiny_openpi_checkpoint: Path, observe: Observe) -> None:
    backend = _backend(tiny_openpi_checkpoint, action_steps=4)
    assert backend.predict(observe()).actions.shape == (4, 7)
    backend.close()


@pytest.mark.parametrize(
    ("field", "word"), [("ee_pose", "ee_pose"), ("gripper_open", "gripper"), ("frames", "primary")]
)
def test_what_is_missing_is_named_and_never_replaced(
    loaded: Pi0Backend, observe: Observe, field: str, word: str
) -> None:
    empty: Any = {} if field == "frames" else None
    with pytest.raises(UngroundedError, match=word):
        loaded.predict(replace(observe(wrist=5), **{field: empty}))


def test_a_wrist_camera_can_be_made_compulsory(tiny_checkpoint: Path, observe: Observe) -> None:
    backend = _backend(tiny_checkpoint, optional_roles=())
    with pytest.raises(UngroundedError, match="wrist"):
        backend.predict(observe())
    backend.close()


def test_joints_are_read_by_name(tiny_checkpoint: Path, observe: Observe) -> None:
    names = tuple(f"joint{i}" for i in range(7))
    own = {
        "state": {"terms": ["joints", "gripper_open"], "joint_names": names},
        "action": _OWN_ACTION,
    }
    backend = _backend(tiny_checkpoint, profile="own", **own)
    with pytest.raises(UngroundedError, match="joint0"):
        backend.predict(observe())
    joints = JointSample(names=("finger", *reversed(names)), position=np.arange(8.0))
    assert backend.predict(replace(observe(), joints=joints)).actions.shape == (10, 7)
    bad = replace(joints, position=np.full(8, np.nan))
    with pytest.raises(UnsafeError, match="non-finite"):
        backend.predict(replace(observe(), joints=bad))
    backend.close()


def test_non_finite_output_is_unsafe_and_nothing_is_returned(
    tiny_checkpoint: Path, observe: Observe
) -> None:
    backend = _backend(tiny_checkpoint)
    with torch.no_grad():
        backend._model._network.action_out_proj.bias[0] = float("nan")  # type: ignore[union-attr]
    with pytest.raises(UnsafeError, match="non-finite"):
        backend.predict(observe())
    backend.close()


def test_an_instruction_that_is_too_long_is_refused_not_cut(
    loaded: Pi0Backend, observe: Observe
) -> None:
    with pytest.raises(UngroundedError, match="at most 48"):
        loaded.predict(observe(instruction="pick up the cube " * 30))
    with pytest.raises(UngroundedError, match="empty"):
        loaded.predict(observe(instruction=" \n "))


def test_load_predict_close_are_refused_or_harmless_out_of_order(
    tiny_checkpoint: Path, observe: Observe
) -> None:
    backend = Pi0Backend(Pi0Options(checkpoint=tiny_checkpoint))
    backend.close()
    with pytest.raises(StateError):
        backend.predict(observe())
    with pytest.raises(ConfigurationError):
        Pi0Backend(Pi0Options(checkpoint=tiny_checkpoint), acceleration=object())


def test_without_a_profile_nothing_is_guessed(tiny_checkpoint: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(tiny_checkpoint, tmp_path / "copy"))
    (copy / "roboneuron.json").unlink()
    with pytest.raises(ConfigurationError, match="libero, libero-openpi, bridge, own"):
        _backend(copy)
    (copy / "roboneuron.json").write_text('{"profile": "mars"}')
    with pytest.raises(ConfigurationError, match="mars"):
        _backend(copy)


def test_a_profile_of_another_width_is_refused(tiny_checkpoint: Path) -> None:
    own = {"state": {"terms": ["position"]}, "action": _OWN_ACTION}
    with pytest.raises(CheckpointError, match="8 state values, the profile has 3"):
        _backend(tiny_checkpoint, profile="own", **own)


def test_a_missing_or_foreign_tokenizer_is_refused(tiny_checkpoint: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(tiny_checkpoint, tmp_path / "copy"))
    tokenizer = copy / "tokenizer.json"
    tokenizer.rename(tmp_path / "elsewhere.json")
    with pytest.raises(CheckpointError, match=r"no tokenizer .*paligemma"):
        _backend(copy)
    _backend(copy, tokenizer=tmp_path / "elsewhere.json").close()
    for text in (
        "not json",
        "{}",
        (tmp_path / "elsewhere.json").read_text().replace("<bos>", "<xxx>"),
    ):
        tokenizer.write_text(text)
        with pytest.raises(CheckpointError, match=r"tokenizer"):
            _backend(copy)


@pytest.mark.skipif(torch.cuda.is_available(), reason="asks for a GPU that is not there")
def test_a_device_that_is_not_there_is_refused(tiny_checkpoint: Path) -> None:
    backend = Pi0Backend(Pi0Options(checkpoint=tiny_checkpoint, device="cuda:0"))
    with pytest.raises(ConfigurationError, match="cuda:0"):
        backend.load()


def test_more_steps_than_the_chunk_has_are_refused(tiny_checkpoint: Path) -> None:
    with pytest.raises(ConfigurationError, match="action_steps"):
        _backend(tiny_checkpoint, action_steps=11)


def test_camera_slots_are_assigned_by_name_or_by_the_user() -> None:
    assert resolve_slots(("image", "image2", "empty_camera_0"), None) == ("primary", "wrist", "-")
    assert resolve_slots(("top", "side"), ("-", "primary")) == ("-", "primary")
    for slots, wanted in (
        (("top",), None),
        (("top",), ("primary", "wrist")),
        (("a", "b"), ("-", "-")),
        (("a", "b"), ("x", "x")),
    ):
        with pytest.raises(ConfigurationError):
            resolve_slots(slots, wanted)


_OWN_ACTION = {
    "meaning": "delta",
    "frame": "base",
    "rotation": "rotvec",
    "gripper": "open_fraction",
    "step_s": 0.1,
}

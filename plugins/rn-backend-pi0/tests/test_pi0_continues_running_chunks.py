"""Real-time chunking of pi0, compared with LeRobot 0.6.1 on the same tiny checkpoint.

data/pi0-rtc.npz and data/prefix-weights.npz are excerpts of golden sets made with the original
code; models, images and prompts are those of data/pi0-tiny. `_vjp` arrays hold the paper's rule
with the full Jacobian.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rn_backend_pi0.chunking import Prefix, RunningChunk, guidance_weights, prefix_weights
from rn_backend_pi0.conversion import TcpConversion
from rn_backend_pi0.layouts import read_checkpoint
from rn_backend_pi0.model import Pi0Model, flow_times
from rn_backend_pi0.native import Pi0Backend
from rn_backend_pi0.options import Pi0Options
from roboneuron.contract import Ahead, Observation

Observe = Callable[..., Observation]
DATA = Path(__file__).parent / "data"
RTC = dict(np.load(DATA / "pi0-rtc.npz"))
WEIGHTS = dict(np.load(DATA / "prefix-weights.npz"))
CASES: dict[str, dict[str, Any]] = {
    case["name"]: case for case in json.loads(str(RTC["cases_json"]))
}
OBSERVATIONS = {
    "main": (("base", "wrist", None), "", ""),
    "other_prompt": (("base", "wrist", None), "_alt", ""),
    "other_state": (("base", "wrist", None), "", "_alt"),
    "three_cameras": (("base", "wrist", "third"), "", ""),
}
FLOAT32 = 5e-5
"""Float32 against float64 differs by 2.2e-5 at most; mistakes by 0.05 and more."""


@pytest.fixture(scope="module")
def models(golden_directory: Path) -> dict[int, Pi0Model]:
    """The golden weights with LeRobot's arithmetic, by number of Euler steps."""
    checkpoint = read_checkpoint(golden_directory)
    return {
        steps: Pi0Model(
            checkpoint,
            device="cpu",
            dtype="float32",
            numerics="lerobot",
            steps=steps,
            cpu_threads=1,
        )
        for steps in (5, 10)
    }


def prefix_of(case: dict[str, Any], **changes: Any) -> Prefix | None:
    if not case["rtc_enabled"] or not case["prev"]:
        return None
    horizon = case["execution_horizon"]
    left = RTC[f"in/{case['name']}/prev_chunk_left_over"]
    prefix = Prefix(
        rows=left,
        committed=case["inference_delay"],
        horizon=case["config_execution_horizon"] if horizon < 0 else horizon,
        schedule=case["schedule"].lower(),
        max_weight=case["max_guidance_weight"],
    )
    return replace(prefix, **changes)


def infer(
    models: dict[int, Pi0Model],
    golden: dict[str, np.ndarray],
    case: dict[str, Any],
    prefix: Prefix | None,
) -> np.ndarray:
    cameras, prompt, state = OBSERVATIONS[case["obs"]]
    images = [None if name is None else golden[f"in/image_{name}"] for name in cameras]
    tokens = golden[f"in/prompt{prompt}_tokens"][golden[f"in/prompt{prompt}_mask"]]
    noise = RTC.get(f"in/{case['noise']}", golden.get(f"in/{case['noise']}"))
    assert noise is not None
    return models[case["num_steps"]].infer(
        images, tokens.tolist(), golden[f"in/state{state}_raw"], noise[0], prefix=prefix
    )


@pytest.mark.parametrize("name", CASES)
def test_guided_chunks_are_lerobot_s(
    models: dict[int, Pi0Model], golden: dict[str, np.ndarray], name: str
) -> None:
    case = CASES[name]
    actions = infer(models, golden, case, prefix_of(case))
    np.testing.assert_allclose(actions, RTC[f"out/{name}/actions_norm"], atol=FLOAT32, rtol=0)


@pytest.mark.parametrize("name", [name for name in CASES if f"out/{name}/actions_norm_vjp" in RTC])
def test_the_full_jacobian_is_the_paper_s(
    models: dict[int, Pi0Model], golden: dict[str, np.ndarray], name: str
) -> None:
    case = CASES[name]
    actions = infer(models, golden, case, prefix_of(case, jacobian="full"))
    # Random weights have large Jacobians, so each case gives its difference between float32 and
    # float64.
    expected, tolerance = RTC[f"out/{name}/actions_norm_vjp"], 10 * max(case["f64_diff_vjp"], 1e-6)
    np.testing.assert_allclose(actions, expected, atol=tolerance, rtol=0)


def test_prefix_weights_are_those_of_the_reference() -> None:
    expected = WEIGHTS["weights/reference"]
    schedules = ("zeros", "ones", "linear", "exp")
    for row, (start, end, total, schedule) in enumerate(
        WEIGHTS["weights/start_end_total_schedule"].tolist()
    ):
        if end > total:
            continue  # cannot happen when the horizon is limited to the left-over rows
        ours = prefix_weights(start, end, total, schedules[schedule])  # type: ignore[arg-type]
        np.testing.assert_allclose(ours, expected[row, :total], atol=2e-7)


def test_guidance_weights_are_those_of_lerobot() -> None:
    for name in (name for name in WEIGHTS if name.startswith("guidance/")):
        steps, beta = name.removeprefix("guidance/n").split("_beta")
        times = [1.0 - k / int(steps) for k in range(int(steps))]
        np.testing.assert_allclose(guidance_weights(times, float(beta)), WEIGHTS[name], rtol=1e-9)


def test_a_trained_prefix_is_kept_exactly(
    models: dict[int, Pi0Model], golden: dict[str, np.ndarray]
) -> None:
    case = CASES["linear_d2_h8"]
    prefix = prefix_of(case, trained=True)
    assert prefix is not None
    actions = infer(models, golden, case, prefix)
    np.testing.assert_array_equal(actions[:2, :7], prefix.rows[:2])
    plain = infer(models, golden, case, None)
    assert np.abs(actions[2:] - plain[2:]).max() > 1e-3  # the guidance affects the other rows


def test_inference_without_a_prefix_is_untouched(
    models: dict[int, Pi0Model], golden: dict[str, np.ndarray]
) -> None:
    case = CASES["plain"]
    once = infer(models, golden, case, None)
    infer(models, golden, CASES["linear_d2_h8"], prefix_of(CASES["linear_d2_h8"], jacobian="full"))
    np.testing.assert_array_equal(infer(models, golden, case, None), once)


@pytest.fixture
def backend(tiny_checkpoint: Path) -> Pi0Backend:
    options = Pi0Options(
        checkpoint=tiny_checkpoint, profile="libero", device="cpu", cpu_threads=1, noise="fixed"
    )
    made = Pi0Backend(options)
    made.load()
    return made


def test_the_backend_continues_the_rows_it_is_told_of(
    backend: Pi0Backend, observe: Observe
) -> None:
    first = backend.predict(observe(primary=60))
    assert isinstance(first.context, RunningChunk)
    ahead = Ahead(
        rows=first.actions[2:],
        committed_rows=3,
        step_s=first.step_s,
        context=first.context,
        context_row=2,
    )
    free = backend.predict(observe(primary=200))
    bound = backend.predict(replace(observe(primary=200), ahead=ahead))
    assert (free.conditioned_rows, bound.conditioned_rows) == (0, 3)
    wanted = first.actions[2:5]
    assert np.abs(bound.actions[:3] - wanted).max() < 0.5 * np.abs(free.actions[:3] - wanted).max()


def test_a_context_of_another_backend_is_left_alone(backend: Pi0Backend, observe: Observe) -> None:
    ahead = Ahead(
        rows=np.zeros((3, 7)),
        committed_rows=2,
        step_s=0.05,
        context={"of": "another"},
        context_row=1,
    )
    free = backend.predict(observe())
    same = backend.predict(replace(observe(), ahead=ahead))
    np.testing.assert_array_equal(free.actions, same.actions)
    assert same.conditioned_rows == 0


def test_relative_rows_are_re_expressed_against_the_new_state(backend: Pi0Backend) -> None:
    """The same absolute targets are other relative rows after the state has moved."""
    assert backend._model is not None
    conversion = backend._conversion
    assert isinstance(conversion, TcpConversion)
    profile = conversion.profile
    relative = replace(profile, action=replace(profile.action, adds_state=True))
    backend._conversion = TcpConversion(relative, conversion.base_position_m)
    width = profile.state.width
    old, new = np.zeros(width, np.float32), np.full(width, 0.25, np.float32)
    running = RunningChunk(normalized=np.zeros(backend._model.noise_shape, np.float32), state=old)
    ahead = Ahead(rows=np.zeros((4, 7)), committed_rows=2, step_s=0.05, context=running)
    prefix = backend.prefix_of(ahead, new)
    assert prefix is not None
    score = backend._model.action.head(6)
    before = score.denormalize(running.normalized[:, :6]) + old[:6]
    after = score.denormalize(prefix.rows[:, :6]) + new[:6]
    np.testing.assert_allclose(after, before, atol=1e-6)
    assert not prefix.rows[:, 6:].any()


def test_a_checkpoint_says_that_it_was_trained_on_prefixes(
    tiny_checkpoint: Path, tmp_path: Path, observe: Observe
) -> None:
    import shutil

    copy = tmp_path / "trained"
    shutil.copytree(tiny_checkpoint, copy)
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps({**config, "rtc_training_max_delay": 2}))
    assert read_checkpoint(copy).trained_prefix_rows == 2
    backend = Pi0Backend(Pi0Options(checkpoint=copy, profile="libero", device="cpu", cpu_threads=1))
    backend.load()
    first = backend.predict(observe())
    ahead = Ahead(rows=first.actions, committed_rows=4, step_s=first.step_s, context=first.context)
    second = backend.predict(replace(observe(primary=200), ahead=ahead))
    assert second.conditioned_rows == 2
    np.testing.assert_allclose(second.actions[:2], first.actions[:2], atol=1e-6)


def test_the_times_of_guidance_are_those_of_the_flow() -> None:
    assert guidance_weights(flow_times("lerobot", 10), 10.0)[0] == 10.0

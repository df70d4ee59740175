"""Chunks of the backend compared with those of LeRobot's own engines, on the same frames.

Both run the same kernels on the same numbers, so results may differ only by the rounding of
float32.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lerobot_cell import NAMES, PAIR, RATE_HZ, Load, observe, observe_pair, sizes_of
from lerobot_loops import Call, RealTime, Synchronous

from rn_backend_lerobot.backend import LeRobotBackend
from rn_backend_lerobot.exchange import PolicyChunk
from rn_backend_lerobot.tiny import Policy, make_tiny
from rn_backend_lerobot.tiny_checkpoint import HOME, TinyShape
from roboneuron import Ahead, Observation

TOLERANCE = 1e-6
"""[rad, opening]; float32 numbers around 2 are 2.4e-7 apart."""
TICKS = 18
"""More than two chunks of eight rows."""


@pytest.mark.parametrize("policy", ["act", "smolvla", "pi0", "pi05", "xvla"])
def test_a_chunk_is_what_lerobot_plays_one_action_at_a_time(
    policy: str, checkpoints: dict[str, Path], load: Load
) -> None:
    """LeRobot queries the policy when its queue is empty: at each eighth tick."""
    import torch

    backend = load(policy)
    backend.reset()
    with sizes_of(policy):
        theirs = Synchronous(checkpoints[policy], NAMES)
    torch.manual_seed(0)
    ours: list[np.ndarray] = []
    for tick in range(TICKS):
        seen = observe(tick)
        if tick % 8 == 0:
            ours = list(backend.predict(seen).actions)
            assert len(ours) == 8
        np.testing.assert_allclose(ours[tick % 8], theirs.act(seen), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("policy", ["diffusion", "vqbet"])
def test_a_policy_of_several_observations_gets_one_a_tick_as_in_lerobot(
    policy: str, checkpoints: dict[str, Path], load: Load
) -> None:
    import torch

    backend = load(policy)
    backend.reset()
    theirs = Synchronous(checkpoints[policy], NAMES)
    torch.manual_seed(0)
    for tick in range(TICKS):
        seen = observe(tick)
        chunk = backend.predict(seen)
        assert chunk.actions.shape == (1, len(NAMES))
        np.testing.assert_allclose(chunk.actions[0], theirs.act(seen), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("policy", ["act", "smolvla", "xvla"])
def test_numbers_of_two_arms_go_to_each_arm_by_name(
    policy: Policy, load: Load, tmp_path: Path
) -> None:
    import torch

    folder = tmp_path / policy
    means = (*HOME[:7], *HOME[:7], *HOME[7:], *HOME[7:])
    make_tiny(folder, policy, TinyShape(means=means))
    mapped = {"joints": None, "joint_unit": None, "gripper_unit": None}
    backend = load(policy, checkpoint=folder, names=tuple(PAIR), channels=PAIR, **mapped)
    backend.reset()
    theirs = Synchronous(folder, tuple(PAIR))
    torch.manual_seed(0)
    chunk = backend.predict(observe_pair(0))
    assert chunk.space is not None
    assert chunk.space.keys == tuple(channel["to"] for channel in PAIR.values())
    for row in chunk.actions:
        # lerobot executes the chunk of its first tick
        expected = theirs.act(observe_pair(0))
        np.testing.assert_allclose(row, expected, rtol=0, atol=TOLERANCE)
    left, right = chunk.actions[:, :7], chunk.actions[:, 7:14]
    assert np.abs(left - right).max() > 100 * TOLERANCE


def test_temporal_ensembling_is_asked_row_by_row(
    checkpoints: dict[str, Path], load: Load, tmp_path: Path
) -> None:
    import json
    import shutil

    folder = tmp_path / "act"
    shutil.copytree(checkpoints["act"], folder)
    config = json.loads((folder / "config.json").read_text())
    config |= {"temporal_ensemble_coeff": 0.01, "n_action_steps": 1}
    (folder / "config.json").write_text(json.dumps(config))
    backend = load("act", checkpoint=folder)
    theirs = Synchronous(folder, NAMES)
    for tick in range(TICKS):
        seen = observe(tick)
        chunk = backend.predict(seen)
        np.testing.assert_allclose(chunk.actions, [theirs.act(seen)], rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("policy", ["smolvla", "pi0", "pi05"])
def test_a_chunk_continues_the_running_one_as_in_lerobot(
    policy: str, checkpoints: dict[str, Path], load: Load
) -> None:
    """The prefix is as long as the horizon, so that LeRobot does not pad it."""
    horizon = 6
    with sizes_of(policy):
        theirs = RealTime(checkpoints[policy], NAMES, fps=1.0, horizon=horizon)
    with theirs:
        theirs.see(observe(0))
        theirs.wait_for_calls(1)
        theirs.continue_on(observe(1))
        theirs.wait_for_calls(2)
    first, second = theirs.calls[:2]
    assert first.left is None
    assert second.left is not None
    assert len(second.left) == horizon
    backend = load(policy, rtc_horizon=horizon, action_steps=16)
    running = repeated(backend, observe(0), first)
    np.testing.assert_allclose(running.rows, first.rows, rtol=0, atol=TOLERANCE)
    ahead = ahead_of(running, len(first.rows) - len(rest_of(first, second)), second.delay)
    bound = repeated(backend, replace(observe(1), ahead=ahead), second)
    np.testing.assert_allclose(bound.rows, second.rows, rtol=0, atol=TOLERANCE)
    free = repeated(backend, observe(1), second)
    assert np.abs(free.rows - second.rows).max() > 100 * TOLERANCE


def rest_of(first: Call, second: Call) -> np.ndarray:
    """The rows of the first chunk from the first row of the second one's prefix on."""
    assert second.left is not None
    start = int((first.normalized - second.left[0]).abs().sum(dim=1).argmin())
    return first.rows[start:]


def ahead_of(running: PolicyChunk, row: int, committed: int) -> Ahead:
    """The rows executed during inference: the running chunk from a row on."""
    rows = running.rows[row:]
    return Ahead(
        rows=rows,
        committed_rows=min(committed, len(rows)),
        step_s=1.0 / RATE_HZ,
        context=running,
        context_row=row,
    )


def repeated(backend: LeRobotBackend, seen: Observation, call: Call) -> PolicyChunk:
    """The backend's answer with the noise that LeRobot drew."""
    assert backend._engine is not None
    backend._engine._noise._states = [call.random]
    context = backend.predict(seen).context
    assert isinstance(context, PolicyChunk)
    return context


def test_relative_actions_are_added_to_the_state_they_were_predicted_for(
    checkpoints: dict[str, Path], load: Load, tmp_path: Path
) -> None:
    """The whole chunk is relative, and the remaining rows are given to the next one by their
    targets.
    """
    import json
    import shutil

    folder = tmp_path / "pi05"
    shutil.copytree(checkpoints["pi05"], folder)
    for name in ("config.json", "policy_preprocessor.json", "policy_postprocessor.json"):
        text = (folder / name).read_text()
        document = json.loads(text)
        if name == "config.json":
            document["use_relative_actions"] = True
        for step in document.get("steps", []):
            if "actions_processor" in step["registry_name"]:
                step["config"]["enabled"] = True
        (folder / name).write_text(json.dumps(document))
    plain, relative = load("pi05"), load("pi05", checkpoint=folder)
    plain.reset()
    relative.reset()
    seen = observe(0)
    joints = seen.joints
    assert joints is not None
    moved = relative.predict(seen).actions - plain.predict(seen).actions
    # The gripper is excluded by its name, and stays absolute.
    np.testing.assert_allclose(moved[:, :7], np.tile(joints.position, (8, 1)), atol=1e-5)
    np.testing.assert_allclose(moved[:, 7], 0.0, atol=TOLERANCE)
    assert relative._engine is not None
    running = relative.predict(seen).context
    later = replace(observe(1), ahead=ahead_of(running, 2, 3))
    bound = relative.predict(later)
    free = relative.predict(observe(1))
    target = running.rows[2:5]
    assert bound.conditioned_rows == 3
    assert np.abs(bound.context.rows[:3] - target).max() < 0.02
    assert np.abs(free.context.rows[:3] - target).max() > 0.05


def test_observations_of_several_robots_are_answered_in_one_pass(load: Load) -> None:
    """ACT draws no noise, so each answer equals that of a single observation."""
    backend = load("act")
    several = [observe(number) for number in range(3)]
    together = backend.predict_batch(several)
    for one, seen in zip(together, several, strict=True):
        alone = backend.predict(seen)
        # A batch is summed in another order.
        np.testing.assert_allclose(one.actions, alone.actions, rtol=0, atol=1e-5)
    with pytest.raises(AttributeError):
        load("diffusion").predict_batch  # noqa: B018

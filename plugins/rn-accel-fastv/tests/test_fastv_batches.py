"""Pruning of several observations in one pass: each keeps the same tokens as alone."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from rn_accel_fastv.config import FastVConfig, PresetConfig
from rn_accel_fastv.preset import FastV, FastVP25, FastVP50, FastVP75
from rn_accel_fastv.selection import AttendedTokens
from rn_backend_oft.backend import OftBackend
from rn_backend_oft.config import OftConfig
from rn_backend_oft.plugin import roboneuron_backends
from rn_backend_oft.tiny import make_tiny_oft
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.runtime import TorchRuntime
from rn_testing.fakes import make_observation

PRESETS = {
    "p25": FastVP25,
    "p50": FastVP50,
    "p75": FastVP75,
    "p50 by actions": lambda: FastVP50(PresetConfig(query="actions")),
    "a third after one layer": lambda: FastV(FastVConfig(k=1, r=1 / 3)),
    "nothing": lambda: FastV(FastVConfig(k=1, r=0.0)),
}
INSTRUCTIONS = (
    "pick up the red cube",
    "go",
    "put the small yellow cube into the bowl at the far end",
    "lift it",
)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    path = tmp_path_factory.mktemp("tiny") / "oft"
    make_tiny_oft(path)
    return path


@pytest.fixture(scope="module")
def observations():
    """Eight observations, with different noise and prompts of several lengths."""
    made = []
    for number in range(8):
        drawn = np.random.default_rng(number)
        plain = make_observation(roboneuron_backends()[0], INSTRUCTIONS[number % 4])
        frames = {
            role: dataclasses.replace(
                frame, image=drawn.integers(0, 256, (64, 64, 3), dtype=np.uint8)
            )
            for role, frame in plain.frames.items()
        }
        made.append(dataclasses.replace(plain, frames=frames))
    return made


def _loaded(path, preset) -> OftBackend:
    config = OftConfig(checkpoint=path, profile="libero", constants="libero", proprio=True)
    runtime = TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32"))
    backend = OftBackend(config, runtime=runtime, acceleration=PRESETS[preset]())
    backend.load()
    return backend


@pytest.fixture
def kept(monkeypatch):
    """Every selection of visual tokens, in order."""
    chosen: list[list[int]] = []
    select = AttendedTokens.select

    def spy(self, view):
        positions = select(self, view)
        assert view.key.shape[0] == view.query.shape[0] == 1
        chosen.append(
            []
            if positions is None
            else positions[: -(view.key.shape[2] - 1 - view.visual_count)].tolist()
        )
        return positions

    monkeypatch.setattr(AttendedTokens, "select", spy)
    return chosen


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_each_of_a_batch_keeps_its_own_tokens_and_gives_its_own_actions(
    tiny, observations, kept, preset
):
    backend = _loaded(tiny, preset)
    kept.clear()
    alone = [backend.predict(observation) for observation in observations]
    for count in (2, 3, 8):
        expected = kept[: len(alone)]
        del kept[len(alone) :]
        chunks = backend.predict_batch(observations[:count])
        assert kept[len(alone) :] == expected[:count]
        for chunk, single in zip(chunks, alone, strict=False):
            np.testing.assert_allclose(chunk.actions, single.actions, rtol=0, atol=1e-5)
            assert chunk.metrics["tokens_kept"] == single.metrics["tokens_kept"]
    if preset != "nothing":
        assert len({tuple(tokens) for tokens in kept[: len(alone)]}) == len(alone)


def test_the_choice_hangs_on_no_last_bit(tiny, observations, monkeypatch):
    """The least attended kept token and the most attended dropped one are at least 2e-5 apart, so
    rounding swaps none.
    """
    gaps = []
    attention_of = AttendedTokens._attention

    def spy(self, view):
        attention = attention_of(self, view)
        visual = (
            attention[view.visual_start : view.visual_start + view.visual_count]
            .sort(descending=True)
            .values
        )
        least, most = visual[self.kept(view.visual_count) - 1], visual[self.kept(view.visual_count)]
        gaps.append(float((least - most) / least))
        return attention

    monkeypatch.setattr(AttendedTokens, "_attention", spy)
    for preset in sorted(PRESETS):
        if preset == "nothing":
            continue
        backend = _loaded(tiny, preset)
        for observation in observations:
            backend.predict(observation)
    assert torch.tensor(gaps).min() > 2e-5, sorted(gaps)[:5]

"""When the backend queries its policy, and with which inputs; the policy is a stand-in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot_folders import ARM
from PIL import Image

from rn_backend_lerobot import engine
from rn_backend_lerobot.backend import LeRobotBackend
from rn_backend_lerobot.exchange import ChunkPrefix, PolicyChunk, PolicyObservation
from rn_backend_lerobot.options import LeRobotOptions
from roboneuron import (
    Ahead,
    Frame,
    JointSample,
    Observation,
    StateError,
    UngroundedError,
    UnsafeError,
)

Make = Callable[..., Path]
PERIOD_NS = 50_000_000


@dataclass
class FakeEngine:
    """Implements `PolicyEngine`: row i of a chunk holds i."""

    folder: Any
    options: Any
    names: Sequence[str]
    can_continue: bool = True
    seen: list[PolicyObservation] = field(default_factory=list)
    prefixes: list[ChunkPrefix | None] = field(default_factory=list)
    resets: int = 0
    value: float = 0.0

    def chunk(self, seen: PolicyObservation, prefix: ChunkPrefix | None = None) -> PolicyChunk:
        self.seen.append(seen)
        self.prefixes.append(prefix)
        rows = np.arange(16.0)[:, None] / 100.0 + np.full((16, 8), self.value)
        return PolicyChunk(normalized=rows, rows=rows)  # type: ignore[arg-type]

    def action(self, seen: PolicyObservation) -> PolicyChunk:
        whole = self.chunk(seen)
        return replace(whole, rows=whole.rows[:1])

    def reset(self) -> None:
        self.resets += 1


@pytest.fixture
def load(
    checkpoint: Make, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[LeRobotBackend, FakeEngine]]:
    """Return a function that loads a backend with further options."""
    monkeypatch.setattr(engine, "PolicyEngine", FakeEngine)

    def make(config: Any = None, **more: Any) -> tuple[LeRobotBackend, FakeEngine]:
        folder = checkpoint(config=config or (lambda c: None))
        backend = LeRobotBackend(
            LeRobotOptions.model_validate({**options, "checkpoint": folder, **more})
        )
        backend.load()
        fake = backend._engine
        assert isinstance(fake, FakeEngine)
        fake.seen.clear()
        fake.prefixes.clear()
        return backend, fake

    return make


def see(period: float = 0.0, side: int = 96) -> Observation:
    """An observation `period` periods after the first one."""
    frames = {
        role: Frame(
            camera=camera,
            image=np.full((side, side, 3), 7, np.uint8),
            stamp_ns=1,
            frame_id="optical",
        )
        for role, camera in (("primary", "front"), ("wrist", "wrist"))
    }
    return Observation(
        frames=frames,
        instruction="go",
        joints=JointSample(names=ARM, position=np.linspace(0.0, 0.6, 7)),
        gripper_open=0.25,
        stamp_ns=10**9 + round(period * PERIOD_NS),
    )


def test_the_policy_gets_images_state_and_task_by_its_own_names(load: Any) -> None:
    backend, fake = load()
    chunk = backend.predict(see())
    seen = fake.seen[0]
    assert list(seen.images) == ["observation.images.front", "observation.images.wrist"]
    assert seen.task == "go"
    np.testing.assert_allclose(seen.state, [*np.linspace(0.0, 0.6, 7), 0.25], rtol=1e-6)
    assert chunk.actions.shape == (8, 8)
    assert chunk.step_s == 0.05


def test_a_robot_may_resize_images_before_it_sends_them(load: Any) -> None:
    backend, fake = load(images="resized")
    assert backend.image_sizes == {"front": (96, 96), "wrist": (96, 96)}
    large = see(side=192)
    noise = np.random.default_rng(0).integers(0, 256, (192, 192, 3), dtype=np.uint8)
    large = replace(
        large, frames={role: replace(f, image=noise) for role, f in large.frames.items()}
    )
    resized = np.asarray(Image.fromarray(noise).resize((96, 96), Image.Resampling.BILINEAR))
    small = replace(
        large, frames={role: replace(f, image=resized) for role, f in large.frames.items()}
    )
    for observation in (large, small):
        backend.predict(observation)
    here, there = (seen.images["observation.images.front"] for seen in fake.seen)
    np.testing.assert_array_equal(here, there)


def test_whether_rows_are_continued_is_said_by_the_policy(load: Any) -> None:
    backend, fake = load()
    assert backend.continues_rows
    fake.can_continue = False
    assert not backend.continues_rows


def test_images_of_another_size_that_are_refused_are_not_resized_by_a_robot(load: Any) -> None:
    assert load()[0].image_sizes == {}


def test_action_steps_cut_the_chunk(load: Any) -> None:
    backend, _ = load(action_steps=3)
    assert len(backend.predict(see()).actions) == 3


def test_the_rest_of_the_running_chunk_is_what_was_not_played(load: Any) -> None:
    backend, fake = load()
    first = backend.predict(see())
    ahead = Ahead(
        rows=first.actions[5:], committed_rows=2, step_s=0.05, context=first.context, context_row=5
    )
    bound = backend.predict(replace(see(1), ahead=ahead))
    prefix = fake.prefixes[-1]
    assert prefix is not None
    assert (prefix.first, prefix.committed) == (5, 2)
    assert prefix.answer is first.context
    assert bound.conditioned_rows == 2
    fake.can_continue = False
    assert backend.predict(replace(see(1), ahead=ahead)).conditioned_rows == 0
    assert fake.prefixes[-1] is None


def test_a_policy_that_remembers_is_asked_row_by_row_and_starts_anew_after_a_pause(
    load: Any,
) -> None:
    backend, fake = load(config=lambda c: c.update(n_obs_steps=2))
    fake.resets = 0
    for period in (0, 1, 2, 3.5):
        assert backend.predict(see(period)).actions.shape == (1, 8)
    assert fake.resets == 0
    backend.predict(see(12))
    assert fake.resets == 1
    backend._took_s = 0.5  # the computing time of the policy does not count as a pause
    backend.predict(see(22))
    assert fake.resets == 1
    backend.reset()
    assert fake.resets == 2


def test_images_of_another_size_are_refused_or_fitted(load: Any, tmp_path: Path) -> None:
    backend, fake = load()
    with pytest.raises(UngroundedError, match=r"'front' gives images of 48x48.*trained on 96x96"):
        backend.predict(see(side=48))
    for images, side in (("resized", 96), ("any", 48)):
        backend._options = backend._options.model_copy(update={"images": images})
        backend.predict(see(side=48))
        assert fake.seen[-1].images["observation.images.front"].shape == (side, side, 3)


def test_a_camera_that_is_silent_is_named(load: Any) -> None:
    backend, _ = load()
    blind = replace(see(), frames={"primary": see().frames["primary"]})
    with pytest.raises(UngroundedError, match=r"observation\.images\.wrist' needs the camera"):
        backend.predict(blind)


def test_numbers_that_are_none_are_not_executed(load: Any) -> None:
    backend, fake = load()
    fake.value = float("nan")
    with pytest.raises(UnsafeError, match="non-finite values; nothing is executed"):
        backend.predict(see())


def test_only_a_policy_that_remembers_nothing_offers_batches(load: Any) -> None:
    assert hasattr(load()[0], "predict_batch")


def test_a_policy_that_remembers_offers_none(load: Any) -> None:
    backend, _ = load(config=lambda c: c.update(n_obs_steps=2))
    assert not hasattr(backend, "predict_batch")


def test_it_has_to_be_loaded_once(load: Any) -> None:
    backend, _ = load()
    with pytest.raises(StateError, match="loaded already"):
        backend.load()
    backend.close()
    with pytest.raises(StateError, match="not loaded"):
        backend.predict(see())

"""The backend "lerobot": a LeRobot policy that maps robot observations to action chunks."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rn_backend_lerobot.checkpoint import ImageFeature
from rn_backend_lerobot.exchange import ChunkPrefix, PolicyChunk, PolicyObservation
from rn_backend_lerobot.options import LeRobotOptions
from rn_backend_lerobot.wiring import Wiring, wire
from rn_vla.checkpoint_files import reading
from roboneuron import (
    ActionChunk,
    Ahead,
    Backend,
    ConfigurationError,
    Frame,
    Observation,
    StateError,
    UngroundedError,
    UnsafeError,
)

if TYPE_CHECKING:
    from rn_backend_lerobot.engine import PolicyEngine

_PAUSE_PERIODS = 3.0
"""Periods without an observation after which a policy with a history is reset, not counting its own
computing time: actions planned before a pause are outdated.
"""
_WARM_TASK = "warm up"


class LeRobotBackend:
    """Implements the protocol `Backend`; the constructor only stores the options, `load` does the
    work.
    """

    def __init__(
        self, config: LeRobotOptions, *, runtime: object = None, acceleration: object = None
    ) -> None:
        if runtime is not None or acceleration is not None:
            raise ConfigurationError("Backend 'lerobot' takes no runtime and no acceleration.")
        self._options = config
        self._wiring: Wiring | None = None
        self._engine: PolicyEngine | None = None
        self._last_ns = 0
        self._took_s = 0.0

    def load(self) -> None:
        """Read the checkpoint with LeRobot, move it to the device and run it once.

        Raises:
            CheckpointError, ConfigurationError: see `wire`; LeRobot cannot load the checkpoint.
            MissingDependencyError: LeRobot is missing, of another release, or lacks an extra.
        """
        if self._engine is not None:
            raise StateError("Backend 'lerobot' is loaded already; close it first.")
        from rn_backend_lerobot.engine import PolicyEngine  # heavy

        wiring = wire(self._options)
        names = [meaning.name for meaning in wiring.action.meanings]
        engine = PolicyEngine(wiring.folder, self._options, names)
        self._warm_up(wiring, engine)
        self._wiring, self._engine = wiring, engine
        self.reset()

    def predict(self, observation: Observation) -> ActionChunk:
        """Return the next rows.

        Raises:
            UngroundedError: a camera, a joint, the pose or the gripper is missing.
            UnsafeError: the policy's output is not finite.
            StateError: `load` was not called.
        """
        wiring, engine = self._loaded()
        start_s = time.perf_counter()
        seen = self._see(wiring, observation)
        prefix: ChunkPrefix | None = None
        if wiring.folder.remembers:
            self._note_time(observation, engine)
            answer = engine.action(seen)
        else:
            prefix = self._prefix(engine, observation.ahead)
            answer = engine.chunk(seen, prefix)
        self._took_s = time.perf_counter() - start_s
        committed = 0 if prefix is None else prefix.committed
        return self._chunk(wiring, answer, self._took_s, committed)

    @property
    def predict_batch(self) -> Callable[[Sequence[Observation]], list[ActionChunk]]:
        """One chunk for each observation, in their order; observations of equal shapes share one
        pass.

        Raises:
            AttributeError: the policy keeps a history of observations, so robots cannot share it.
        """
        if wire(self._options).folder.remembers:
            raise AttributeError("predict_batch")
        return self._predict_batch

    @property
    def continues_rows(self) -> bool:
        """True if this policy can continue rows that are executed during inference. A policy that
        cannot may still serve several robots in one batch.
        """
        _, engine = self._loaded()
        return engine.can_continue

    @property
    def image_sizes(self) -> dict[str, tuple[int, int]]:
        """Image size (width, height) [px] by camera role or name to which this backend resizes, so
        that a robot can resize before sending; empty unless the option `images` is "resized".
        """
        wiring, _ = self._loaded()
        if self._options.images != "resized":
            return {}
        wanted: dict[str, set[tuple[int, int]]] = {}
        for feature in wiring.images:
            role = wiring.roles[feature.key] or feature.short
            wanted.setdefault(role, set()).add((feature.width, feature.height))
        return {role: next(iter(sizes)) for role, sizes in wanted.items() if len(sizes) == 1}

    def _predict_batch(self, observations: Sequence[Observation]) -> list[ActionChunk]:
        wiring, engine = self._loaded()
        start_s = time.perf_counter()
        answers = engine.chunks([self._see(wiring, one) for one in observations])
        took_s = time.perf_counter() - start_s
        return [self._chunk(wiring, answer, took_s, 0) for answer in answers]

    def reset(self) -> None:
        """Clear the history of observations, the planned actions and the noise."""
        self._last_ns = 0
        self._took_s = 0.0
        if self._engine is not None:
            self._engine.reset()

    def close(self) -> None:
        """Release the policy; idempotent."""
        self._engine = self._wiring = None

    def _loaded(self) -> tuple[Wiring, PolicyEngine]:
        if self._engine is None or self._wiring is None:
            raise StateError("Backend 'lerobot' is not loaded; call load() first.")
        return self._wiring, self._engine

    def _see(self, wiring: Wiring, observation: Observation) -> PolicyObservation:
        images: dict[str, NDArray[np.uint8]] = {}
        for feature in wiring.images:
            frame = wiring.frame(feature, observation)
            images[feature.key] = self._fit(frame, feature)
        state = wiring.state.read(observation) if wiring.folder.state else None
        return PolicyObservation(images=images, state=state, task=observation.instruction)

    def _fit(self, frame: Frame, feature: ImageFeature) -> NDArray[np.uint8]:
        """Resize the image to the training size, as configured by the option `images`."""
        image, width, height = frame.image, feature.width, feature.height
        if image.shape[:2] == (height, width) or self._options.images == "any":
            return image
        if self._options.images == "resized":
            resized = Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR)
            return np.asarray(resized, dtype=np.uint8)
        raise UngroundedError(
            f"Camera {frame.camera!r} gives images of {image.shape[1]}x{image.shape[0]}, the "
            f"policy was trained on {width}x{height}.",
            hint="Set the camera to that size, or images = 'resized' or 'any' under "
            "[plugins.lerobot].",
        )

    def _note_time(self, observation: Observation, engine: PolicyEngine) -> None:
        """Reset a policy with a history after a pause."""
        now_ns = observation.stamp_ns
        gap_s = (now_ns - self._last_ns) / 1e9 - self._took_s
        if self._last_ns and gap_s > _PAUSE_PERIODS / self._options.rate_hz:
            engine.reset()
        self._last_ns = now_ns

    def _prefix(self, engine: PolicyEngine, ahead: Ahead | None) -> ChunkPrefix | None:
        """The rest of the running chunk; None if there is none or the policy cannot continue it."""
        if ahead is None or not engine.can_continue or not isinstance(ahead.context, PolicyChunk):
            return None
        if ahead.context_row >= len(ahead.context.rows):
            return None
        return ChunkPrefix(
            answer=ahead.context, first=ahead.context_row, committed=ahead.committed_rows
        )

    def _chunk(
        self, wiring: Wiring, answer: PolicyChunk, took_s: float, committed: int
    ) -> ActionChunk:
        steps = self._options.action_steps or wiring.folder.rows
        rows = answer.rows[:steps]
        if rows.shape[1] != wiring.folder.action:
            raise UnsafeError(
                f"The policy answered with {rows.shape[1]} numbers a row; its checkpoint says "
                f"{wiring.folder.action}."
            )
        if not np.isfinite(rows).all():
            raise UnsafeError("The policy produced non-finite values; nothing is executed.")
        return ActionChunk(
            actions=wiring.action.to_contract(rows),
            step_s=1.0 / self._options.rate_hz,
            space=wiring.space,
            metrics={"inference_ms": took_s * 1e3, "chunk_horizon": float(len(rows))},
            context=answer,
            conditioned_rows=min(committed, len(rows)),
        )

    def _warm_up(self, wiring: Wiring, engine: PolicyEngine) -> None:
        """Run the policy once, so that a mismatch is found now and the first real answer is not
        slow.
        """
        images = {
            one.key: np.zeros((one.height, one.width, 3), dtype=np.uint8) for one in wiring.images
        }
        state = np.zeros(wiring.folder.state, dtype=np.float32) if wiring.folder.state else None
        seen = PolicyObservation(images=images, state=state, task=_WARM_TASK)
        with reading(wiring.folder.directory, "a policy that answers"):
            answer = engine.action(seen) if wiring.folder.remembers else engine.chunk(seen)
        if not math.isfinite(float(np.abs(answer.rows).sum())):
            raise UnsafeError(f"{wiring.folder.directory} answers an empty image with NaN.")


if TYPE_CHECKING:
    _: type[Backend] = LeRobotBackend

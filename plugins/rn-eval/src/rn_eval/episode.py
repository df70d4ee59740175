"""One episode on its own clock: simulated time advances in ticks, and a prediction takes its
configured latency.

Chunks are executed by the rules of the inference module (`roboneuron.modules.execution`); actions
pass the controller and the limits of the control module. The wall clock is only used to measure
predictions.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections import Counter
from dataclasses import dataclass, field

from rn_eval.film import FilmStrip
from rn_eval.latency import Draw
from rn_eval.policy import EpisodePolicy
from rn_eval.record import EpisodeOutcome
from rn_eval.suite import Episode, Judgement, Scene
from roboneuron import ActionChunk, NotReadyError, RoboNeuronError
from roboneuron.modules.execution.adaptive import AdaptiveExecutor
from roboneuron.modules.inference import execution

WATCH_S = 0.1
"""Period of the control module's watchdog."""
PATIENCE_S = 3.0
"""A policy that refuses every image for this time counts as having given up."""
_START_NS = 1_000_000_000
"""Stamps begin here, because 0 means "not measured" in messages."""


@dataclass(slots=True)
class _PendingPrediction:
    """A running prediction, and the tick at which it is available."""

    tick: int
    prediction: execution.Prediction
    chunk: ActionChunk | None


@dataclass(slots=True)
class PlayedEpisode:
    """A finished episode.

    Attributes:
        outcome: outcome for the ledger.
        inference_ms: duration of each prediction [ms].
        film: images that the policy received.
    """

    outcome: EpisodeOutcome
    inference_ms: list[float]
    film: FilmStrip


@dataclass(slots=True)
class EpisodeClock:
    """Runs one episode. Single use.

    Attributes:
        scene: an open scene.
        policy: the policy, after `reset`.
        executor: a new executor.
        latency: maps the measured duration of a prediction to the simulated one.
    """

    scene: Scene
    policy: EpisodePolicy
    executor: AdaptiveExecutor
    latency: Draw
    episode: Episode
    _tick: int = 0
    _answer: _PendingPrediction | None = None
    _captured: int = -1
    _refused_tick: int | None = None
    _refusal: str = ""
    _inference_ms: list[float] = field(default_factory=list)
    _limited: Counter[str] = field(default_factory=Counter)
    _answers: Counter[str] = field(default_factory=Counter)
    _modes: Counter[str] = field(default_factory=Counter)
    _sums: dict[str, tuple[float, int]] = field(default_factory=dict)
    _refusals: int = 0
    _rows: int = 0
    _film: FilmStrip = field(default_factory=FilmStrip)
    _digest: hashlib._Hash = field(default_factory=hashlib.sha256)

    def run(self) -> PlayedEpisode:
        """Run until the episode is decided or its time is up."""
        scene = self.scene
        watch_ticks = max(1, round(WATCH_S / scene.tick_s))
        last = math.ceil(self.episode.time_limit_s / scene.tick_s - 1e-9)
        self.executor.begin_epoch()
        judgement = scene.judge()
        while not judgement.is_over and self._tick < last and not self._has_given_up():
            self._take_answer()
            if (
                self._answer is None
                and self._tick % scene.camera_ticks == 0
                and self._captured < self._tick
            ):
                self._predict()
            self._play()
            target = min(self._next(watch_ticks), last)
            scene.advance(target - self._tick)
            self._tick = target
            if self._tick % watch_ticks == 0 or self._tick == last:
                scene.watch(self._now_s)
            if self._tick % scene.judge_ticks == 0 or self._tick == last:
                judgement = scene.judge()
        self._digest.update(scene.state())
        return PlayedEpisode(
            outcome=self._outcome(judgement), inference_ms=self._inference_ms, film=self._film
        )

    @property
    def _now_s(self) -> float:
        return self._tick * self.scene.tick_s

    def _ns(self, tick: int) -> int:
        return _START_NS + round(tick * self.scene.tick_s * 1e9)

    def _next(self, watch_ticks: int) -> int:
        """The next tick with a possible event."""
        events = [
            (self._tick // period + 1) * period for period in (watch_ticks, self.scene.judge_ticks)
        ]
        if self._answer is None:
            events.append((self._tick // self.scene.camera_ticks + 1) * self.scene.camera_ticks)
        else:
            events.append(self._answer.tick)
        due_s = self.executor.due_s()
        if due_s is not None:
            events.append(self._due_tick(due_s))
        return min(tick for tick in events if tick > self._tick)

    def _due_tick(self, due_s: float) -> int:
        return math.ceil(due_s / self.scene.tick_s - 1e-6)

    def _predict(self) -> None:
        if not self.executor.wants_prediction(self._now_s):
            return
        self._captured = self._tick
        captured_ns = self._ns(self._tick)
        prediction = self.executor.begin(self.scene.observe(captured_ns), captured_ns)
        chunk: ActionChunk | None = None
        begun_s = time.perf_counter()
        try:
            chunk = self.policy.predict(prediction.observation)
        except RoboNeuronError as error:
            self._refusals += 1
            self._refusal = str(error)
            self._refused_tick = self._tick if self._refused_tick is None else self._refused_tick
        else:
            self._refused_tick = None
        took_s = time.perf_counter() - begun_s
        self._inference_ms.append(round(took_s * 1e3, 3))
        lasts = math.ceil(self.latency(took_s) / self.scene.tick_s - 1e-9)
        self._answer = _PendingPrediction(self._tick + lasts, prediction, chunk)
        frame = next(iter(prediction.observation.frames.values()), None)
        if frame is not None:
            self._film.add(self._now_s, "refused" if chunk is None else chunk.note, frame.image)
        self._take_answer()

    def _take_answer(self) -> None:
        answer = self._answer
        if answer is None or self._tick < answer.tick:
            return
        self._answer = None
        if answer.chunk is None:
            return
        self._answers[
            self.executor.answer(answer.prediction, answer.chunk, self._ns(self._tick))
        ] += 1
        self._modes[answer.prediction.mode] += 1
        for name, value in answer.chunk.metrics.items():
            total, count = self._sums.get(name, (0.0, 0))
            self._sums[name] = (total + float(value), count + 1)

    def _play(self) -> None:
        due_s = self.executor.due_s()
        if due_s is None or self._tick < self._due_tick(due_s):
            return
        try:
            row = self.executor.play(max(self._now_s, due_s), self._ns(self._tick))
        except NotReadyError:
            self._limited["image_too_old"] += 1
            return
        if row is None:
            return
        self._rows += 1
        self._digest.update(row.vector.tobytes())
        word = self.scene.act(row.vector, self._now_s)
        if word:
            self._limited[word] += 1

    def _has_given_up(self) -> bool:
        since = self._refused_tick
        return since is not None and (self._tick - since) * self.scene.tick_s > PATIENCE_S

    def _outcome(self, judgement: Judgement) -> EpisodeOutcome:
        reason = "" if judgement.success else judgement.reason
        if not judgement.is_over and self._has_given_up():
            reason = f"The policy refused: {self._refusal}"
        return EpisodeOutcome(
            status="success" if judgement.success else "failure",
            reason=reason,
            duration_s=round(self._now_s, 4),
            predictions=len(self._inference_ms),
            rows=self._rows,
            refusals=self._refusals,
            limited=dict(sorted(self._limited.items())),
            answers=dict(sorted(self._answers.items())),
            starved_periods=self.executor.status().delivery.starved_periods,
            modes=dict(sorted(self._modes.items())),
            metrics={
                name: round(total / count, 6) for name, (total, count) in sorted(self._sums.items())
            },
            facts=dict(judgement.facts),
            digest=self._digest.hexdigest(),
        )

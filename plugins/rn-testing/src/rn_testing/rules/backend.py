"""Rules of backends: predictions within the descriptor's declaration, in time, repeatable; unusable
inputs are refused.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from rn_testing.cases import BackendCase
from rn_testing.effects import check_quick, min_until
from rn_testing.lifecycle import Lifecycle
from rn_testing.rule import NotApplicable, Rule, Violation, require
from rn_testing.rules.clock import later
from rn_testing.rules.continuing import ContinuingRules
from rn_testing.snapshots import snapshot
from roboneuron import (
    ActionChunk,
    Backend,
    Frame,
    Observation,
    RoboNeuronError,
    UngroundedError,
)

MAX_TRANSLATION_M, MAX_ROTATION_RAD = 0.25, 1.0
"""Largest plausible single action; more is a wrong unit: policies act at 5 Hz or more, arms move
below 1 m/s.
"""
LONGEST_NOTE, MOST_METRICS = 300, 100
"""Maximum length of a note in characters, and number of metrics of a chunk, because all are shown
in every status.
"""
ROW_OPTIONS = (
    "horizon",
    "rows",
    "chunk_size",
    "chunk_length",
    "action_horizon",
    "actions_per_chunk",
)
"""Options with which users choose the number of rows of a chunk."""
INSTRUCTIONS = {
    "no instruction": "",
    "an instruction of spaces": "   ",
    "an instruction in another script": "拿起红色的方块 — отпусти 🟥",
    "an instruction of two lines": "pick up\nthe cube",
    "an instruction of 2,000 characters": "pick it up " * 180,
}
"""Instructions as people may type them, outside a policy's training data."""
LEAST_BETWEEN, MOST_BETWEEN, BETWEEN_S = 3, 400, 1.0
"""Predictions between two resets: at least, at most, and the time after which no more are made [s].
Many, because a small drift with each adds up to more than REPEATED.
"""
REPEATED = 1e-3
"""Tolerance of repeated predictions, for rounding of parallel sums on a GPU [m, rad, opening]."""


def _load(case: BackendCase, backend: Backend) -> None:
    backend.load()


def predict(
    case: BackendCase, backend: Backend, observation: Observation | None = None
) -> ActionChunk:
    """Predict a chunk; an automatic case that cannot be grounded is not applicable."""
    try:
        chunk = backend.predict(case.observation() if observation is None else observation)
    except UngroundedError as error:
        if case.is_automatic and case.observe is None:
            raise NotApplicable(f"it cannot act on a synthetic image: {error}") from error
        raise
    require(
        isinstance(chunk, ActionChunk),
        f"predict returned {type(chunk).__name__}, expected an ActionChunk",
    )
    return chunk


def _predict_blind(case: BackendCase, backend: Backend) -> object:
    return backend.predict(replace(case.observation(), frames={}))


LIFECYCLE: Lifecycle[BackendCase, Backend] = Lifecycle(
    subject="backend",
    protocol=Backend,
    begin="load",
    start=_load,
    uses={"predict": predict},
    abuses=(_predict_blind,),
    besides=("reset",),
    repeat=10,
    # a quick one may call an arm stuck after some hundred images of a scene that does not change
    ends=(UngroundedError,),
    renew=lambda backend: backend.reset(),
)
"""Start and use of a backend."""
loaded = LIFECYCLE.running


def with_images(
    observation: Observation, change: Callable[[Frame], NDArray[np.uint8]]
) -> Observation:
    """Return the observation with changed images."""
    frames = {
        role: replace(frame, image=change(frame)) for role, frame in observation.frames.items()
    }
    return replace(observation, frames=frames)


def _check_predict(case: BackendCase) -> None:
    with loaded(case) as backend:
        chunk = predict(case, backend)
    horizon = case.spec.action_space.horizon
    count = chunk.actions.shape[0]
    require(
        count <= horizon,
        f"a chunk holds {count} actions, the descriptor declares a horizon of {horizon}",
    )


def _check_metrics(case: BackendCase) -> None:
    with loaded(case) as backend:
        chunk = predict(case, backend)
    odd = [
        n
        for n, v in chunk.metrics.items()
        if not isinstance(v, (int, float)) or not math.isfinite(v)
    ]
    require(not odd, f"metrics that are not finite numbers: {', '.join(odd)}")
    count = len(chunk.metrics)
    require(count <= MOST_METRICS, f"a chunk has {count} metrics, at most {MOST_METRICS} are shown")
    require("\n" not in chunk.note, "the note has more than one line")
    length = len(chunk.note)
    require(
        length <= LONGEST_NOTE, f"the note has {length} characters, expected one short sentence"
    )


def _rows_wanted(case: BackendCase) -> int | None:
    """Expected number of rows of a chunk: from an option that the case sets, or the descriptor;
    None for any.
    """
    names = [name for name in ROW_OPTIONS if name in case.option_names()]
    if names:
        value = case.options[names[0]]
        return value if isinstance(value, int) else None
    model = case.option_model()
    regulated = model is not None and any(name in model.model_fields for name in ROW_OPTIONS)
    # otherwise checkpoint or server determine rows and step
    is_fixed = case.spec.action_space.step_s > 0
    return case.spec.action_space.horizon if is_fixed and not regulated else None


def _check_rows(case: BackendCase) -> None:
    wanted = _rows_wanted(case) if case.rows is None else case.rows
    if wanted is None:
        raise NotApplicable(
            "options or checkpoint set the number of rows of a chunk; give it as `rows` in the case"
        )
    with loaded(case) as backend:
        count = len(predict(case, backend).actions)
    require(count == wanted, f"a chunk holds {count} actions, expected {wanted}")


def _check_instructions(case: BackendCase) -> None:
    observation = case.observation()
    with loaded(case) as backend:
        for what, text in INSTRUCTIONS.items():
            try:
                backend.predict(replace(observation, instruction=text))
            except RoboNeuronError:
                continue
            except Exception as error:
                raise Violation(
                    f"predict with {what} raised {type(error).__name__}: {error}"
                ) from error


def _check_units(case: BackendCase) -> None:
    with loaded(case) as backend:
        chunk = predict(case, backend)
    if chunk.space.kind != "ee_delta":
        raise NotApplicable(f"its chunks are in {chunk.space.kind}")
    actions = chunk.actions
    far_m = float(np.linalg.norm(actions[:, :3], axis=1).max())
    far_rad = float(np.linalg.norm(actions[:, 3:6], axis=1).max())
    require(
        far_m <= MAX_TRANSLATION_M,
        f"one action moves the TCP by {far_m:.3g} m; are those millimetres?",
    )
    require(
        far_rad <= MAX_ROTATION_RAD,
        f"one action turns the TCP by {far_rad:.3g} rad; are those degrees?",
    )


def _check_step(case: BackendCase) -> None:
    declared = case.spec.action_space.step_s
    if declared == 0 and "step_s" not in case.options:
        raise NotApplicable("the descriptor leaves step_s to the checkpoint")
    wanted = case.options.get("step_s", declared)
    assert isinstance(wanted, (int, float))
    with loaded(case) as backend:
        step_s = predict(case, backend).step_s
    require(abs(step_s - wanted) <= 1e-6, f"a chunk has step_s {step_s:g}, expected {wanted:g}")


def _check_quick(case: BackendCase) -> None:
    with loaded(case) as backend:
        check_quick(case.predict_limit_s, lambda: predict(case, backend), "predict")


def _check_first_quick(case: BackendCase) -> None:
    observation = case.observation()

    def first_s() -> float:
        with loaded(case) as backend:
            begun_s = time.perf_counter()
            predict(case, backend, observation)
            return time.perf_counter() - begun_s

    quickest_s = min_until(first_s, case.predict_limit_s)
    require(
        quickest_s <= case.predict_limit_s,
        f"the first predict takes {quickest_s:.3g} s, at most {case.predict_limit_s:g} s are "
        "allowed; read weights and warm up in load",
    )


def _check_reset(case: BackendCase) -> None:
    with loaded(case) as backend:
        backend.reset()
        predict(case, backend)
        backend.reset()
        backend.reset()
        predict(case, backend)


def compare_chunks(first: ActionChunk, again: ActionChunk, when: str) -> None:
    require(first.actions.shape == again.actions.shape, f"{when} the number of actions differs")
    drift = float(np.abs(first.actions - again.actions).max())
    require(
        drift <= REPEATED and first.step_s == again.step_s,
        f"{when} the chunk differs by {drift:.3g}",
    )


def _check_forgets(case: BackendCase) -> None:
    observation = case.observation()
    other = with_images(observation, lambda frame: 255 - frame.image)
    begun_s = time.monotonic()
    with loaded(case) as backend:
        backend.reset()
        first = predict(case, backend, observation)
        for count in range(MOST_BETWEEN):
            seen = replace(other, instruction="put it down") if count == 1 else observation
            try:
                backend.predict(seen)
            except RoboNeuronError:  # the other image may show nothing to act on
                continue
            if count >= LEAST_BETWEEN and time.monotonic() - begun_s > BETWEEN_S:
                break
        backend.reset()
        again = predict(case, backend, observation)
        with later():
            backend.reset()
            much_later = predict(case, backend, observation)
    compare_chunks(first, again, "for the same observation, each time after reset(),")
    compare_chunks(first, much_later, "for the same observation, an hour later after reset(),")


def _check_repeats(case: BackendCase) -> None:
    observation = case.observation()
    chunks: list[ActionChunk] = []
    for _ in range(2):
        with loaded(case) as backend:
            backend.reset()
            chunks.append(predict(case, backend, observation))
    compare_chunks(
        chunks[0], chunks[1], "for the same observation, of two backends with the same options,"
    )


def _shaded(frame: Frame, shade: int) -> NDArray[np.uint8]:
    return np.full_like(frame.image, shade)


def _check_chunk_kept(case: BackendCase) -> None:
    observation = case.observation()
    with loaded(case) as backend:
        first = predict(case, backend, observation)
        before = snapshot(first)
        for shade in (0, 255):
            try:
                backend.predict(with_images(observation, partial(_shaded, shade=shade)))
            except RoboNeuronError:
                continue
    require(snapshot(first) == before, "a chunk changes when the next one is predicted")


_SOURCE = "roboneuron.contract.protocols.Backend"


def backend_rule(
    name: str, text: str, source: str, check: Callable[[BackendCase], None]
) -> Rule[BackendCase]:
    """A rule of backends."""
    return Rule(id=f"backend/{name}", text=text, source=source, check=check)


RULES: tuple[Rule[BackendCase], ...] = (
    *LIFECYCLE.rules(),
    backend_rule(
        "predict-within-horizon",
        "After `load`, `predict` returns a chunk of at most the declared horizon, and needs "
        "only the declared inputs.",
        f"{_SOURCE}.predict",
        _check_predict,
    ),
    backend_rule(
        "metrics-numeric",
        "The metrics of a chunk are finite numbers, not too many, and its note is one short line.",
        "roboneuron.contract.action.ActionChunk",
        _check_metrics,
    ),
    backend_rule(
        "rows-declared",
        "A chunk has as many rows as the descriptor's horizon, or as an option or the case says.",
        "roboneuron.plugins.specs.ActionSpace",
        _check_rows,
    ),
    backend_rule(
        "any-instruction",
        "`predict` acts on any instruction or refuses it with an error of roboneuron.errors.",
        f"{_SOURCE}.predict",
        _check_instructions,
    ),
    backend_rule(
        "units",
        f"No action moves the TCP by over {MAX_TRANSLATION_M:g} m or turns it by over "
        f"{MAX_ROTATION_RAD:g} rad.",
        "roboneuron.contract.action",
        _check_units,
    ),
    backend_rule(
        "step-declared",
        "The chunk's `step_s` is the descriptor's, or that of an option `step_s` the case sets.",
        "roboneuron.plugins.specs.ActionSpace",
        _check_step,
    ),
    backend_rule(
        "predict-quick",
        "`predict` answers within the case's `predict_limit_s`.",
        f"{_SOURCE}.predict",
        _check_quick,
    ),
    backend_rule(
        "first-predict-quick",
        "The first `predict` after `load` answers within `predict_limit_s` too.",
        f"{_SOURCE}.load",
        _check_first_quick,
    ),
    backend_rule(
        "reset-safe",
        "`reset` may be called at any time after `load`, also twice, and `predict` works after it.",
        f"{_SOURCE}.reset",
        _check_reset,
    ),
    backend_rule(
        "reset-forgets",
        "After `reset` the same observation yields the same chunk, whatever came before and "
        "whatever the time; `reset` seeds samplers.",
        f"{_SOURCE}.reset",
        _check_forgets,
    ),
    backend_rule(
        "repeatable",
        "Two backends with the same options yield the same chunk for the same observation.",
        f"{_SOURCE}.predict",
        _check_repeats,
    ),
    backend_rule(
        "chunk-kept",
        "A returned chunk is not changed later.",
        "roboneuron.contract.action.ActionChunk",
        _check_chunk_kept,
    ),
    *ContinuingRules(loaded, predict, backend_rule).rules(),
)
"""Rules of backends, without those of `backend_observation` and `backend_space`."""

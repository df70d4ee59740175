"""Rules of backends: predict within what the descriptor declares, in time, repeatably; refuse what cannot be used."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from rn_testing.cases import BackendCase
from rn_testing.effects import check_quick, expect_refusal
from rn_testing.fakes import gradient_image
from rn_testing.lifecycle import Lifecycle
from rn_testing.rule import NotApplicable, Rule, require
from rn_testing.rules.continuing import ContinuingRules
from rn_testing.snapshots import snapshot
from roboneuron.contract import ActionChunk, Backend, Frame, Observation
from roboneuron.contract.image import U8
from roboneuron.errors import InvalidInputError, RoboNeuronError, UngroundedError

MAX_TRANSLATION_M, MAX_ROTATION_RAD = 0.25, 1.0
"""Largest single action that is no mistake of unit: policies act at 5 Hz and more, arms move below 1 m/s."""
REPEATED = 1e-3
"""How far a repeated prediction may differ: what parallel sums on a GPU round differently [m, rad, opening]."""


def _load(case: BackendCase, backend: Backend) -> None:
    backend.load()


def _predict(case: BackendCase, backend: Backend, observation: Observation | None = None) -> ActionChunk:
    try:
        chunk = backend.predict(case.observation() if observation is None else observation)
    except UngroundedError as error:
        if case.is_automatic and case.observe is None:
            raise NotApplicable(f"it cannot act on a synthetic image: {error}") from error
        raise
    require(isinstance(chunk, ActionChunk), f"predict returned {type(chunk).__name__}, expected an ActionChunk")
    return chunk


LIFECYCLE: Lifecycle[BackendCase, Backend] = Lifecycle(
    subject="backend", protocol=Backend, begin="load", start=_load, uses={"predict": _predict}, repeat=10
)
"""How a backend is started and used."""
_loaded = LIFECYCLE.running


def _with_images(observation: Observation, change: Callable[[Frame], U8]) -> Observation:
    frames = {role: replace(frame, image=change(frame)) for role, frame in observation.frames.items()}
    return replace(observation, frames=frames)


def _check_predict(case: BackendCase) -> None:
    with _loaded(case) as backend:
        chunk = _predict(case, backend)
    horizon = case.spec.action_space.horizon
    count = chunk.actions.shape[0]
    require(count <= horizon, f"a chunk holds {count} actions, the descriptor declares a horizon of {horizon}")


def _check_metrics(case: BackendCase) -> None:
    with _loaded(case) as backend:
        chunk = _predict(case, backend)
    odd = [name for name, value in chunk.metrics.items() if not isinstance(value, (int, float))]
    require(not odd, f"metrics that are no numbers: {', '.join(odd)}")
    require("\n" not in chunk.note, "the note has more than one line")


def _check_units(case: BackendCase) -> None:
    with _loaded(case) as backend:
        actions = _predict(case, backend).actions
    far_m = float(np.linalg.norm(actions[:, :3], axis=1).max())
    far_rad = float(np.linalg.norm(actions[:, 3:6], axis=1).max())
    require(far_m <= MAX_TRANSLATION_M, f"one action moves the TCP by {far_m:.3g} m; are those millimetres?")
    require(far_rad <= MAX_ROTATION_RAD, f"one action turns the TCP by {far_rad:.3g} rad; are those degrees?")


def _check_step(case: BackendCase) -> None:
    declared = case.spec.action_space.step_s
    if declared == 0 and "step_s" not in case.options:
        raise NotApplicable("the descriptor leaves step_s to the checkpoint")
    wanted = case.options.get("step_s", declared)
    assert isinstance(wanted, (int, float))
    with _loaded(case) as backend:
        step_s = _predict(case, backend).step_s
    require(abs(step_s - wanted) <= 1e-6, f"a chunk has step_s {step_s:g}, declared is {wanted:g}")


def _check_quick(case: BackendCase) -> None:
    with _loaded(case) as backend:
        check_quick(case.predict_limit_s, lambda: _predict(case, backend), "predict")


def _check_reset(case: BackendCase) -> None:
    with _loaded(case) as backend:
        backend.reset()
        _predict(case, backend)
        backend.reset()
        backend.reset()
        _predict(case, backend)


def _compare(first: ActionChunk, again: ActionChunk, when: str) -> None:
    require(first.actions.shape == again.actions.shape, f"{when} the number of actions differs")
    drift = float(np.abs(first.actions - again.actions).max())
    require(drift <= REPEATED and first.step_s == again.step_s, f"{when} the chunk differs by {drift:.3g}")


def _check_forgets(case: BackendCase) -> None:
    observation = case.observation()
    other = _with_images(observation, lambda frame: 255 - frame.image)
    with _loaded(case) as backend:
        backend.reset()
        first = _predict(case, backend, observation)
        for seen in (observation, replace(other, instruction="put it down"), observation):
            try:
                backend.predict(seen)
            except RoboNeuronError:  # the other picture may show nothing to act on
                continue
        backend.reset()
        again = _predict(case, backend, observation)
    _compare(first, again, "for the same observation, each time after reset(),")


def _check_repeats(case: BackendCase) -> None:
    observation = case.observation()
    chunks: list[ActionChunk] = []
    for _ in range(2):
        with _loaded(case) as backend:
            backend.reset()
            chunks.append(_predict(case, backend, observation))
    _compare(chunks[0], chunks[1], "for the same observation, of two backends with the same options,")


def _check_chunk_kept(case: BackendCase) -> None:
    observation = case.observation()
    with _loaded(case) as backend:
        first = _predict(case, backend, observation)
        before = snapshot(first)
        for shade in (0, 255):
            try:
                backend.predict(_with_images(observation, lambda frame, s=shade: np.full_like(frame.image, s)))  # type: ignore[misc]
            except RoboNeuronError:
                continue
    require(snapshot(first) == before, "a chunk changes when the next one is predicted")


def _without_each_frame(case: BackendCase, whole: Observation) -> Iterator[tuple[str, Observation]]:
    for role in case.spec.cameras:
        yield role, replace(whole, frames={name: frame for name, frame in whole.frames.items() if name != role})


def _check_missing_frame(case: BackendCase) -> None:
    if not case.spec.cameras:
        raise NotApplicable("it declares no cameras")
    with _loaded(case) as backend:
        for role, blind in _without_each_frame(case, case.observation()):
            what = f"predict without the frame {role!r}"
            expect_refusal(lambda o=blind: backend.predict(o), what, InvalidInputError, UngroundedError)  # type: ignore[misc]


def _check_missing_state(case: BackendCase) -> None:
    if not case.spec.needs_state:
        raise NotApplicable("it declares no state")
    with _loaded(case) as backend:
        numb = replace(case.observation(), joints=None, ee_pose=None, gripper_open=None)
        expect_refusal(lambda: backend.predict(numb), "predict without the state it declares")


def _check_nan_state(case: BackendCase) -> None:
    if not case.spec.needs_state:
        raise NotApplicable("it declares no state")
    whole = case.observation()
    if whole.joints is None or whole.ee_pose is None:
        raise NotApplicable("the case's observation has no joints or no pose")
    for number in (np.nan, np.inf):
        joints = replace(whole.joints, position=np.full_like(whole.joints.position, number))
        pose = replace(whole.ee_pose, position_m=np.full(3, number))
        all_bad = replace(whole, joints=joints, ee_pose=pose, gripper_open=float(number))
        parts = {
            "joints": replace(whole, joints=joints),
            "TCP position": replace(whole, ee_pose=pose),
            "gripper opening": replace(whole, gripper_open=float(number)),
        }
        with _loaded(case) as backend:
            expect_refusal(lambda o=all_bad: backend.predict(o), f"predict with a state of {number}", RoboNeuronError)  # type: ignore[misc]
            backend.reset()
            good = _predict(case, backend, whole)
            for name, bad in parts.items():
                backend.reset()
                try:
                    chunk = backend.predict(bad)
                except RoboNeuronError:
                    continue
                drift = (
                    float(np.abs(chunk.actions - good.actions).max())
                    if chunk.actions.shape == good.actions.shape
                    else 1
                )
                require(drift <= REPEATED, f"predict acts on a {name} of {number}")


def _check_input_kept(case: BackendCase) -> None:
    observation = case.observation()
    before = snapshot(observation)
    with _loaded(case) as backend:
        _predict(case, backend, observation)
    require(snapshot(observation) == before, "predict wrote into its observation")


def _check_any_size(case: BackendCase) -> None:
    observation = case.observation()
    with _loaded(case) as backend:
        for width, height in ((64, 48), (48, 64), (641, 479)):
            seen = _with_images(observation, lambda frame, w=width, h=height: gradient_image(w, h))  # type: ignore[misc]
            _try_image(backend, seen, f"{width}x{height}")
        strided = _with_images(observation, lambda frame: np.repeat(frame.image, 2, axis=1)[:, ::2])
        _try_image(backend, strided, "that is not contiguous in memory")


def _try_image(backend: Backend, observation: Observation, what: str) -> None:
    try:
        backend.predict(observation)
    except RoboNeuronError:
        return
    except Exception as error:
        require(False, f"predict with an image {what} raised {type(error).__name__}: {error}")


def _check_optional(case: BackendCase) -> None:
    if not case.spec.optional_cameras:
        raise NotApplicable("it declares no optional cameras")
    observation = case.observation()
    frame = next(iter(observation.frames.values()))
    more = {role: replace(frame, camera=role) for role in case.spec.optional_cameras}
    with _loaded(case) as backend:
        _predict(case, backend, replace(observation, frames={**observation.frames, **more}))


_SOURCE = "roboneuron.contract.protocols.Backend"


def _rule(name: str, text: str, source: str, check: Callable[[BackendCase], None]) -> Rule[BackendCase]:
    return Rule(id=f"backend/{name}", text=text, source=source, check=check)


RULES: tuple[Rule[BackendCase], ...] = (
    *LIFECYCLE.rules(),
    _rule(
        "predict-within-horizon",
        "After `load`, `predict` returns a chunk of at most the declared horizon, from the declared inputs alone.",
        f"{_SOURCE}.predict",
        _check_predict,
    ),
    _rule(
        "metrics-numeric",
        "The metrics of a chunk are numbers and its note is one line.",
        "roboneuron.contract.action.ActionChunk",
        _check_metrics,
    ),
    _rule(
        "units",
        f"No action moves the TCP by over {MAX_TRANSLATION_M:g} m or turns it by over {MAX_ROTATION_RAD:g} rad.",
        "roboneuron.contract.action",
        _check_units,
    ),
    _rule(
        "step-declared",
        "The chunk's `step_s` is the descriptor's, or that of an option `step_s` the case sets.",
        "roboneuron.plugins.specs.ActionSpace",
        _check_step,
    ),
    _rule(
        "predict-quick", "`predict` answers within the case's `predict_limit_s`.", f"{_SOURCE}.predict", _check_quick
    ),
    _rule(
        "reset-safe",
        "`reset` may be called at any time after `load`, also twice, and `predict` works after it.",
        f"{_SOURCE}.reset",
        _check_reset,
    ),
    _rule(
        "reset-forgets",
        "After `reset` an observation yields the same chunk, whatever was seen before; samplers are seeded there.",
        f"{_SOURCE}.reset",
        _check_forgets,
    ),
    _rule(
        "repeatable",
        "Two backends with the same options yield the same chunk for the same observation.",
        f"{_SOURCE}.predict",
        _check_repeats,
    ),
    _rule(
        "chunk-kept",
        "A chunk that was returned is not written to later.",
        "roboneuron.contract.action.ActionChunk",
        _check_chunk_kept,
    ),
    _rule(
        "missing-frame-refused",
        "An observation that lacks a declared camera role is an InvalidInputError or an UngroundedError.",
        f"{_SOURCE}.predict",
        _check_missing_frame,
    ),
    _rule(
        "missing-state-refused",
        "A backend that declares to need state refuses an observation without it.",
        f"{_SOURCE}.predict",
        _check_missing_state,
    ),
    _rule(
        "nan-state-refused",
        "A state that is not finite is refused; a part of it that is not refused has no influence.",
        f"{_SOURCE}.predict",
        _check_nan_state,
    ),
    _rule(
        "input-kept",
        "`predict` accepts read-only images and writes into no part of its observation.",
        "roboneuron.contract.image.frame_from_buffer",
        _check_input_kept,
    ),
    _rule(
        "any-image-size",
        "`predict` acts on images of any size and memory layout, or refuses them with an error of roboneuron.errors.",
        "roboneuron.contract.observation.Frame",
        _check_any_size,
    ),
    _rule(
        "optional-frames-used",
        "`predict` works with the optional camera roles too.",
        "roboneuron.plugins.specs.BackendSpec",
        _check_optional,
    ),
    *ContinuingRules(_loaded, _predict, _rule).rules(),
)
"""Rules of backends."""

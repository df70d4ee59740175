"""Rules of backends: load, predict within what the descriptor declares, refuse what cannot be acted on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from roboneuron.contract import ActionChunk, Backend, Observation
from roboneuron.errors import RoboNeuronError, StateError, UngroundedError
from roboneuron.testing.cases import BackendCase
from roboneuron.testing.effects import expect_refusal
from roboneuron.testing.lifecycle import (
    attempt,
    check_close_before_start,
    check_close_twice_and_release,
    check_protocol,
    check_pure_constructor,
    started,
)
from roboneuron.testing.rule import NotApplicable, Rule, require


@contextmanager
def _loaded(case: BackendCase) -> Iterator[Backend]:
    with started(case, case.build, lambda backend: backend.load()) as backend:
        yield backend


def _predict(case: BackendCase, backend: Backend, observation: Observation) -> ActionChunk:
    try:
        chunk = backend.predict(observation)
    except UngroundedError as error:
        if case.is_automatic and case.observe is None:
            raise NotApplicable(f"it cannot act on a synthetic image: {error}") from error
        raise
    require(isinstance(chunk, ActionChunk), f"predict returned {type(chunk).__name__}, expected an ActionChunk")
    return chunk


def _check_protocol(case: BackendCase) -> None:
    check_protocol(attempt(case, case.build), Backend)


def _check_pure(case: BackendCase) -> None:
    check_pure_constructor(case, case.build)


def _check_close_first(case: BackendCase) -> None:
    check_close_before_start(case, case.build)


def _check_predict(case: BackendCase) -> None:
    with _loaded(case) as backend:
        chunk = _predict(case, backend, case.observation())
    horizon = case.spec.action_space.horizon
    count = chunk.actions.shape[0]
    require(count <= horizon, f"a chunk holds {count} actions, the descriptor declares a horizon of {horizon}")


def _check_metrics(case: BackendCase) -> None:
    with _loaded(case) as backend:
        chunk = _predict(case, backend, case.observation())
    odd = [name for name, value in chunk.metrics.items() if not isinstance(value, (int, float))]
    require(not odd, f"metrics that are no numbers: {', '.join(odd)}")
    require("\n" not in chunk.note, "the note has more than one line")


def _check_reset(case: BackendCase) -> None:
    with _loaded(case) as backend:
        backend.reset()
        _predict(case, backend, case.observation())
        backend.reset()
        backend.reset()
        _predict(case, backend, case.observation())


def _check_release(case: BackendCase) -> None:
    check_close_twice_and_release(case, case.build, lambda backend: backend.load())


def _check_predict_first(case: BackendCase) -> None:
    backend = attempt(case, case.build)
    try:
        expect_refusal(lambda: backend.predict(case.observation()), "predict before load", StateError)
    finally:
        backend.close()


def _check_predict_last(case: BackendCase) -> None:
    with _loaded(case) as backend:
        pass
    expect_refusal(lambda: backend.predict(case.observation()), "predict after close", StateError)


def _check_missing_frame(case: BackendCase) -> None:
    if not case.spec.cameras:
        raise NotApplicable("it declares no cameras")
    with _loaded(case) as backend:
        whole = case.observation()
        for role in case.spec.cameras:
            rest = {name: frame for name, frame in whole.frames.items() if name != role}
            blind = replace(whole, frames=rest)
            expect_refusal(lambda o=blind: backend.predict(o), f"predict without the frame {role!r}")  # type: ignore[misc]


def _check_missing_state(case: BackendCase) -> None:
    if not case.spec.needs_state:
        raise NotApplicable("it declares no state")
    with _loaded(case) as backend:
        numb = replace(case.observation(), joints=None, ee_pose=None, gripper_open=None)
        expect_refusal(lambda: backend.predict(numb), "predict without the state it declares")


def _check_nan_state(case: BackendCase) -> None:
    if not case.spec.needs_state:
        raise NotApplicable("it declares no state")
    with _loaded(case) as backend:
        whole = case.observation()
        if whole.joints is None or whole.ee_pose is None:
            raise NotApplicable("the case's observation has no joints or no pose")
        bad_joints = replace(whole.joints, position=np.full_like(whole.joints.position, np.nan))
        bad_pose = replace(whole.ee_pose, position_m=np.full(3, np.nan))
        bad = replace(whole, joints=bad_joints, ee_pose=bad_pose, gripper_open=float("nan"))
        expect_refusal(lambda: backend.predict(bad), "predict with a state of NaN", RoboNeuronError)


def _check_input_kept(case: BackendCase) -> None:
    with _loaded(case) as backend:
        observation = case.observation()
        before = {role: frame.image.copy() for role, frame in observation.frames.items()}
        for frame in observation.frames.values():
            frame.image.flags.writeable = False
        _predict(case, backend, observation)
        changed = [r for r, image in before.items() if not np.array_equal(image, observation.frames[r].image)]
    require(not changed, f"predict wrote into the image of {', '.join(changed)}")


_SOURCE = "roboneuron.contract.protocols.Backend"

RULES: tuple[Rule[BackendCase], ...] = (
    Rule(
        id="backend/protocol",
        text="It has the methods of Backend.",
        source=_SOURCE,
        check=_check_protocol,
    ),
    Rule(
        id="backend/constructor-pure",
        text="The constructor opens no file, starts no thread or process and computes nothing that takes time.",
        source="roboneuron.contract.protocols",
        check=_check_pure,
    ),
    Rule(
        id="backend/close-before-load",
        text="`close` may be called twice and before `load`.",
        source=f"{_SOURCE}.close",
        check=_check_close_first,
    ),
    Rule(
        id="backend/predict-within-horizon",
        text="After `load`, `predict` returns a chunk of at most the declared horizon, from the declared inputs alone.",
        source=f"{_SOURCE}.predict",
        check=_check_predict,
    ),
    Rule(
        id="backend/metrics-numeric",
        text="The metrics of a chunk are numbers and its note is one line.",
        source="roboneuron.contract.action.ActionChunk",
        check=_check_metrics,
    ),
    Rule(
        id="backend/reset-safe",
        text="`reset` may be called at any time after `load`, also twice, and `predict` works after it.",
        source=f"{_SOURCE}.reset",
        check=_check_reset,
    ),
    Rule(
        id="backend/close-releases",
        text="After `load`, `close` may be called twice and leaves no thread or process behind.",
        source=f"{_SOURCE}.close",
        check=_check_release,
    ),
    Rule(
        id="backend/predict-before-load-refused",
        text="`predict` before `load` is a StateError.",
        source=f"{_SOURCE}.predict",
        check=_check_predict_first,
    ),
    Rule(
        id="backend/predict-after-close-refused",
        text="`predict` after `close` is a StateError.",
        source=f"{_SOURCE}.predict",
        check=_check_predict_last,
    ),
    Rule(
        id="backend/missing-frame-refused",
        text="An observation that lacks a declared camera role is refused.",
        source=f"{_SOURCE}.predict",
        check=_check_missing_frame,
    ),
    Rule(
        id="backend/missing-state-refused",
        text="A backend that declares to need state refuses an observation without it.",
        source=f"{_SOURCE}.predict",
        check=_check_missing_state,
    ),
    Rule(
        id="backend/nan-state-refused",
        text="A state that is not finite is refused.",
        source=f"{_SOURCE}.predict",
        check=_check_nan_state,
    ),
    Rule(
        id="backend/images-kept",
        text="`predict` accepts read-only images and writes into none.",
        source="roboneuron.contract.image.frame_from_buffer",
        check=_check_input_kept,
    ),
)
"""Rules of backends."""

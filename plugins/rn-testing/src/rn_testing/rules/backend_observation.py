"""Rules of backends on observations: inputs that are missing, not finite, of another size, or
read-only.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from rn_testing.cases import BackendCase
from rn_testing.effects import expect_refusal
from rn_testing.fakes import gradient_image
from rn_testing.rule import NotApplicable, Rule, require
from rn_testing.rules.backend import REPEATED, backend_rule, loaded, predict, with_images
from rn_testing.snapshots import snapshot
from roboneuron import (
    ArmState,
    Backend,
    InvalidInputError,
    Observation,
    RoboNeuronError,
    UngroundedError,
)

_SOURCE = "roboneuron.contract.protocols.Backend"
FOREIGN_ROLE = "overhead"
"""Role of a camera that no backend declares."""


def _without_each_frame(case: BackendCase, whole: Observation) -> Iterator[tuple[str, Observation]]:
    """Observations that lack one declared role: alone, and with another camera that must not stand
    in for it.
    """
    for role in case.spec.cameras:
        frames = {name: frame for name, frame in whole.frames.items() if name != role}
        yield f"the frame {role!r}", replace(whole, frames=frames)
        for other in (*case.spec.optional_cameras, FOREIGN_ROLE):
            more = {**frames, other: replace(whole.frames[role], camera=other)}
            yield f"the frame {role!r} but with {other!r}", replace(whole, frames=more)


def _check_missing_frame(case: BackendCase) -> None:
    if not case.spec.cameras:
        raise NotApplicable("it declares no cameras")
    with loaded(case) as backend:
        for what, blind in _without_each_frame(case, case.observation()):
            expect_refusal(
                partial(backend.predict, blind),
                f"predict without {what}",
                InvalidInputError,
                UngroundedError,
            )


def _check_missing_state(case: BackendCase) -> None:
    if not case.spec.needs_state:
        raise NotApplicable("it declares no state")
    with loaded(case) as backend:
        numb = replace(case.observation(), joints=None, ee_pose=None, gripper_open=None, arms={})
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
        arms = {name: ArmState(ee_pose=pose, gripper_open=float(number)) for name in whole.arms}
        all_bad = replace(whole, joints=joints, ee_pose=pose, gripper_open=float(number), arms=arms)
        parts = {
            "joints": replace(whole, joints=joints),
            "TCP position": replace(whole, ee_pose=pose),
            "gripper opening": replace(whole, gripper_open=float(number)),
        }
        with loaded(case) as backend:
            expect_refusal(
                partial(backend.predict, all_bad),
                f"predict with a state of {number}",
                RoboNeuronError,
            )
            backend.reset()
            good = predict(case, backend, whole)
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
    with loaded(case) as backend:
        predict(case, backend, observation)
    require(snapshot(observation) == before, "predict changed its observation")


def _check_any_size(case: BackendCase) -> None:
    observation = case.observation()
    with loaded(case) as backend:
        for width, height in ((64, 48), (48, 64), (641, 479)):
            seen = with_images(observation, lambda frame, w=width, h=height: gradient_image(w, h))  # type: ignore[misc]
            _try_image(backend, seen, f"{width}x{height}")
        strided = with_images(observation, lambda frame: np.repeat(frame.image, 2, axis=1)[:, ::2])
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
    with loaded(case) as backend:
        predict(case, backend, replace(observation, frames={**observation.frames, **more}))


RULES: tuple[Rule[BackendCase], ...] = (
    backend_rule(
        "missing-frame-refused",
        "An observation that lacks a declared camera role is an InvalidInputError or an "
        "UngroundedError, whatever other cameras it has.",
        f"{_SOURCE}.predict",
        _check_missing_frame,
    ),
    backend_rule(
        "missing-state-refused",
        "A backend that declares that it needs state refuses an observation without it.",
        f"{_SOURCE}.predict",
        _check_missing_state,
    ),
    backend_rule(
        "nan-state-refused",
        "A state with a value that is not finite is refused, or that value has no influence.",
        f"{_SOURCE}.predict",
        _check_nan_state,
    ),
    backend_rule(
        "input-kept",
        "`predict` accepts read-only images and does not change its observation.",
        "roboneuron.contract.image.frame_from_buffer",
        _check_input_kept,
    ),
    backend_rule(
        "any-image-size",
        "`predict` acts on images of any size and memory layout, or refuses them with an error of "
        "roboneuron.errors.",
        "roboneuron.contract.observation.Frame",
        _check_any_size,
    ),
    backend_rule(
        "optional-frames-used",
        "`predict` works with the optional camera roles too.",
        "roboneuron.plugins.specs.BackendSpec",
        _check_optional,
    ),
)
"""Rules of backends on observations."""

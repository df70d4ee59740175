"""Rules of backends on observations: inputs that are missing, not finite, of another size, or
read-only.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from rn_testing.cases import BackendCase
from rn_testing.effects import expect_refusal
from rn_testing.fakes import gradient_image
from rn_testing.rule import NotApplicable, Rule, require
from rn_testing.rules.backend import (
    REPEATED,
    backend_rule,
    compare_chunks,
    loaded,
    predict,
    with_images,
)
from rn_testing.rules.clock import ros_clock
from rn_testing.snapshots import snapshot
from roboneuron import (
    ArmState,
    Backend,
    InvalidInputError,
    Observation,
    Pose,
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


def _turned(observation: Observation) -> Observation:
    """The same observation with cameras, joints and arms in the opposite order."""
    joints = observation.joints
    if joints is not None:
        joints = replace(
            joints,
            names=joints.names[::-1],
            position=joints.position[::-1],
            velocity=None if joints.velocity is None else joints.velocity[::-1],
        )
    return replace(
        observation,
        joints=joints,
        frames=dict(list(observation.frames.items())[::-1]),
        arms=dict(list(observation.arms.items())[::-1]),
    )


def _at(observation: Observation, stamp_ns: int) -> Observation:
    """The same observation at another time."""
    shift_ns = stamp_ns - observation.stamp_ns
    frames = {
        role: replace(frame, stamp_ns=frame.stamp_ns + shift_ns)
        for role, frame in observation.frames.items()
    }

    def moved(pose: Pose) -> Pose:
        return replace(pose, stamp_ns=pose.stamp_ns + shift_ns)

    joints, pose = observation.joints, observation.ee_pose
    return replace(
        observation,
        stamp_ns=stamp_ns,
        frames=frames,
        joints=joints and replace(joints, stamp_ns=joints.stamp_ns + shift_ns),
        ee_pose=pose and moved(pose),
        arms={
            name: replace(arm, ee_pose=moved(arm.ee_pose)) for name, arm in observation.arms.items()
        },
    )


def _check_alike(case: BackendCase, others: dict[str, Observation]) -> None:
    with loaded(case) as backend:
        backend.reset()
        first = predict(case, backend)
        for what, other in others.items():
            backend.reset()
            compare_chunks(first, predict(case, backend, other), what)


def _check_by_name(case: BackendCase) -> None:
    turned = _turned(case.observation())
    if turned.joints is None and len(turned.frames) + len(turned.arms) < 2:
        raise NotApplicable("its observations have one part only")
    _check_alike(case, {"with cameras, joints and arms in another order": turned})


def _check_clock_free(case: BackendCase) -> None:
    observation = case.observation()
    _check_alike(
        case,
        {
            f"at {stamp_ns / 1e9:.0f} s of ROS time": _at(observation, stamp_ns)
            for stamp_ns in (10_000_000_000, time.time_ns(), ros_clock())
        },
    )


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
        "inputs-by-name",
        "Cameras, joints and arms are taken by name, in any order.",
        "roboneuron.contract.observation.Observation",
        _check_by_name,
    ),
    backend_rule(
        "clock-free",
        "The same observation at another ROS time, also that of a simulation, yields the same "
        "chunk.",
        "roboneuron.contract.observation.Observation",
        _check_clock_free,
    ),
    backend_rule(
        "optional-frames-used",
        "`predict` works with the optional camera roles too.",
        "roboneuron.plugins.specs.BackendSpec",
        _check_optional,
    ),
)
"""Rules of backends on observations."""

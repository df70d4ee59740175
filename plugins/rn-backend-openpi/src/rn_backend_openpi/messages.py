"""Observations, chunks and errors as messages of openpi's websocket, and back.

The robot's images, state and instruction are entries as of openpi's servers; everything else is in
one map at `RESERVED`, which other clients do not send and other servers do not read.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

import roboneuron
from rn_backend_openpi.state import state_entries, state_of
from rn_backend_openpi.wire import array, numbers
from roboneuron import (
    EE_DELTA,
    MAX_SIDE_PX,
    ActionChunk,
    Ahead,
    CameraCalibration,
    CheckpointError,
    ConfigurationError,
    ControlSpace,
    ForeignDataError,
    Frame,
    InvalidInputError,
    MissingDependencyError,
    NotReadyError,
    Observation,
    PluginError,
    RoboNeuronError,
    StateError,
    UngroundedError,
    UnsafeError,
    foreign,
    frame_from_compressed,
)

RESERVED = "roboneuron"
"""The only entry of a message beside those of openpi."""
PROMPT = "prompt"
Document = dict[str, Any]
_IMAGE = re.compile(r"observation/(?:([a-z][a-z0-9_]{0,63})_)?image")
_MOST_CAMERAS = 16
_MOST_NAMES = 256
MOST_ROWS = 4096
_MOST_METRICS = 128
_ERRORS: dict[str, type[RoboNeuronError]] = {
    kind.code: kind
    for kind in (
        CheckpointError,
        ConfigurationError,
        InvalidInputError,
        MissingDependencyError,
        NotReadyError,
        PluginError,
        StateError,
        UngroundedError,
        UnsafeError,
    )
}


@dataclass(frozen=True, slots=True)
class HeldContext:
    """Reference to the context of a chunk (see `ActionChunk.context`), which stays in the server.

    Attributes:
        session: number of the connection that holds it.
        number: number of the request whose answer has it.
    """

    session: int
    number: int


Held = Callable[[HeldContext], object]
"""Looks a context up in the server; None if it is no longer held."""


def image_key(role: str) -> str:
    """Key of a camera's image."""
    return "observation/image" if role == "primary" else f"observation/{role}_image"


def from_observation(observation: Observation) -> Document:
    """Encode an observation, with a context only as the server's reference.

    Raises:
        UnsafeError: a number of its state is not finite.
    """
    joints, pose, ahead = observation.joints, observation.ee_pose, observation.ahead
    images = {image_key(role): frame.image for role, frame in observation.frames.items()}
    own: Document = {
        "frames": {role: _from_frame(frame) for role, frame in observation.frames.items()},
        "stamp_ns": observation.stamp_ns,
        "joints_stamp_ns": 0 if joints is None else joints.stamp_ns,
        "pose_stamp_ns": 0 if pose is None else pose.stamp_ns,
        "arm_stamps_ns": {name: arm.ee_pose.stamp_ns for name, arm in observation.arms.items()},
        "ahead": None if ahead is None else _from_ahead(ahead),
    }
    return {PROMPT: observation.instruction, **images, **state_entries(observation), RESERVED: own}


def _from_ahead(ahead: Ahead) -> Document:
    held = ahead.context
    return {
        "rows": ahead.rows,
        "committed_rows": ahead.committed_rows,
        "step_s": ahead.step_s,
        "context": [held.session, held.number] if isinstance(held, HeldContext) else None,
        "context_row": ahead.context_row,
        "state_ahead_s": ahead.state_ahead_s,
    }


def _from_frame(frame: Frame) -> Document:
    known = frame.calibration
    return {
        "camera": frame.camera,
        "stamp_ns": frame.stamp_ns,
        "frame_id": frame.frame_id,
        "calibration": None
        if known is None
        else [known.intrinsics, known.mount, known.T_mount_camera],
    }


def to_observation(document: object, held: Held = lambda context: None) -> Observation:
    """Decode an observation of any client of openpi's websocket.

    Raises:
        ForeignDataError: a field is missing, or has not the type and range of the contract.
        RoboNeuronError: as the contract's own types.
    """
    entries = foreign.table(document, "a request")
    own = foreign.table(entries.get(RESERVED, {}), RESERVED)
    told = foreign.table(own.get("frames", {}), "frames", _MOST_CAMERAS)
    images = {found[1] or "primary": key for key in entries if (found := _image(key))}
    if len(images) > _MOST_CAMERAS:
        raise ForeignDataError(f"{len(images)} images are more than {_MOST_CAMERAS}")
    state, ahead = state_of(entries), own.get("ahead")
    joints, pose, stamps = state.joints, state.ee_pose, own.get("arm_stamps_ns", {})
    if joints is not None:
        joints = replace(joints, stamp_ns=_stamp(own, "joints_stamp_ns"))
    return Observation(
        frames={role: _to_frame(role, entries[key], told) for role, key in images.items()},
        instruction=foreign.text(foreign.field(document, PROMPT), PROMPT, foreign.MOST_TEXT),
        joints=joints,
        ee_pose=None if pose is None else replace(pose, stamp_ns=_stamp(own, "pose_stamp_ns")),
        gripper_open=state.gripper_open,
        arms={
            name: replace(arm, ee_pose=replace(arm.ee_pose, stamp_ns=_stamp(stamps, name)))
            for name, arm in state.arms.items()
        },
        ahead=None if ahead is None else _to_ahead(ahead, held),
        stamp_ns=_stamp(own, "stamp_ns"),
    )


def has_coded_images(document: Document) -> bool:
    """True if an image of a request is coded, or malformed."""
    return any(_image(key) and not isinstance(document[key], np.ndarray) for key in document)


def _image(key: object) -> re.Match[str] | None:
    return _IMAGE.fullmatch(key) if isinstance(key, str) else None


def _stamp(document: object, name: str) -> int:
    return foreign.integer(foreign.table(document, "stamps").get(name, 0), f"the stamp {name!r}")


def _to_ahead(value: object, held: Held) -> Ahead:
    rows = numbers(foreign.field(value, "rows"), "rows ahead", (None, None))
    if len(rows) > MOST_ROWS:
        raise InvalidInputError(f"{len(rows)} rows ahead are more than {MOST_ROWS}.")
    named = foreign.field(value, "context")
    context = None if named is None else held(_to_context(named))
    return Ahead(
        rows=rows,
        committed_rows=foreign.integer(foreign.field(value, "committed_rows"), "committed_rows"),
        step_s=foreign.number(foreign.field(value, "step_s"), "step_s"),
        context=context,
        context_row=foreign.integer(foreign.field(value, "context_row"), "context_row"),
        state_ahead_s=foreign.number(foreign.field(value, "state_ahead_s"), "state_ahead_s"),
    )


def _to_frame(role: str, image: object, told: Document) -> Frame:
    own = foreign.table(told.get(role, {}), "a frame")
    known = own.get("calibration")
    return Frame(
        camera=foreign.text(own.get("camera", role), "camera"),
        image=decode_image(image),
        stamp_ns=_stamp(own, "stamp_ns"),
        frame_id=foreign.text(own.get("frame_id", ""), "frame_id"),
        calibration=None if known is None else _to_calibration(known),
    )


def decode_image(value: object) -> NDArray[np.uint8]:
    """Decode a received image.

    Raises:
        ForeignDataError: it is invalid, or its size differs from the announced one.
    """
    if isinstance(value, np.ndarray):
        raw: NDArray[np.uint8] = array(value, "an image", "|u1", (None, None, 3))
        return raw
    coding = foreign.field(value, "coding")
    height, width = (
        foreign.integer(foreign.field(value, name), name, 1, MAX_SIDE_PX)
        for name in ("height", "width")
    )
    data = array(foreign.field(value, "data"), "data of an image", "|u1", (None,))
    if coding not in ("png", "jpeg"):
        raise ForeignDataError("the coding of an image is unknown")
    try:
        decoded: NDArray[np.uint8] = frame_from_compressed(data, coding)
    except InvalidInputError as error:
        raise ForeignDataError(error.message.rstrip(".")) from error
    if decoded.shape != (height, width, 3):
        raise ForeignDataError(f"an image of {decoded.shape} was not announced")
    return decoded


def _to_calibration(value: object) -> CameraCalibration:
    intrinsics, mount, pose = foreign.items(value, "a calibration", most=3, least=3)
    return CameraCalibration(
        intrinsics=numbers(intrinsics, "intrinsics", (3, 3)),
        mount=foreign.text(mount, "mount"),
        T_mount_camera=numbers(pose, "T_mount_camera", (4, 4)),
    )


def from_answer(
    answer: ActionChunk | RoboNeuronError, context: HeldContext | None = None
) -> Document:
    """Encode a chunk or an error.

    Args:
        answer: answer of the model.
        context: reference to the chunk's context, which stays in the server.
    """
    if isinstance(answer, RoboNeuronError):
        return {RESERVED: from_error(answer)}
    values = np.array(list(answer.metrics.values()), dtype=np.float64)
    own: Document = {
        "space": from_space(answer.space),
        "metrics": [list(answer.metrics), values],
        "note": answer.note,
        "context": None if context is None else [context.session, context.number],
        "conditioned_rows": answer.conditioned_rows,
    }
    timing = {"infer_ms": float(answer.metrics.get("shared.model_ms", 0.0))}
    return {
        "actions": answer.actions,
        "step_s": answer.step_s,
        "policy_timing": timing,
        RESERVED: own,
    }


def from_error(error: RoboNeuronError) -> Document:
    """Encode an error, as a map at `RESERVED` has it; see `raise_told`."""
    return {
        "error": error.code,
        "message": error.message[: foreign.MOST_TEXT],
        "hint": error.hint[: foreign.MOST_TEXT],
    }


def raise_told(document: Mapping[str, object]) -> None:
    """Raise the error in a map at `RESERVED`, if there is one."""
    if "error" in document:
        kind = _ERRORS.get(foreign.text(document["error"], "an error"), PluginError)
        message = foreign.text(foreign.field(document, "message"), "a message", foreign.MOST_TEXT)
        raise kind(
            message, hint=foreign.text(foreign.field(document, "hint"), "a hint", foreign.MOST_TEXT)
        )


def to_answer(document: Mapping[str, object]) -> ActionChunk:
    """Decode a chunk.

    Raises:
        RoboNeuronError: the received error.
        ForeignDataError: it is neither a chunk nor an error.
    """
    own = foreign.table(foreign.field(document, RESERVED), RESERVED)
    raise_told(own)
    told, values = foreign.items(foreign.field(own, "metrics"), "metrics", most=2, least=2)
    named = foreign.items(told, "metrics", most=_MOST_METRICS)
    names = [foreign.text(name, "a metric", 64) for name in named]
    values = array(values, "metrics", "<f8", (len(names),))
    context = foreign.field(own, "context")
    return ActionChunk(
        actions=numbers(foreign.field(document, "actions"), "actions", (None, None)),
        step_s=foreign.number(foreign.field(document, "step_s"), "step_s"),
        metrics=dict(zip(names, values.tolist(), strict=True)),
        note=foreign.text(foreign.field(own, "note"), "a note", foreign.MOST_TEXT),
        context=None if context is None else _to_context(context),
        conditioned_rows=foreign.integer(
            foreign.field(own, "conditioned_rows"), "conditioned_rows"
        ),
        space=to_space(foreign.field(own, "space")),
    )


def _to_context(value: object) -> HeldContext:
    session, count = foreign.items(value, "a context", most=2, least=2)
    return HeldContext(foreign.integer(session, "a context"), foreign.integer(count, "a context"))


def from_space(space: ControlSpace) -> list[object]:
    """Encode a control space."""
    channels = [[c.name, c.unit, c.frame, c.arm] for c in space.channels]
    return [space.kind, space.rate_hz, channels]


def to_space(value: object) -> ControlSpace:
    """Decode a control space; the default one becomes the contract's own object.

    Raises:
        ForeignDataError: it is malformed.
        RoboNeuronError: as `ControlSpace`.
    """
    kind, rate_hz, channels = foreign.items(value, "a space", most=3, least=3)
    named = [
        tuple(
            foreign.text(word, "a channel")
            for word in foreign.items(channel, "a channel", most=4, least=4)
        )
        for channel in foreign.items(channels, "channels", most=_MOST_NAMES)
    ]
    return _space(
        foreign.text(kind, "kind of a space"), tuple(named), foreign.number(rate_hz, "rate_hz")
    )


@lru_cache(maxsize=1)  # a model answers always in the same one
def _space(kind: str, named: tuple[tuple[str, ...], ...], rate_hz: float) -> ControlSpace:
    channels = tuple(
        roboneuron.Channel(name=name, unit=unit, frame=frame, arm=arm)
        for name, unit, frame, arm in named
    )
    space = ControlSpace(kind=kind, channels=channels, rate_hz=rate_hz)
    return EE_DELTA if space == EE_DELTA else space

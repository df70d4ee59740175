"""Encoding of observations, chunks and errors as documents of frames, and decoding with a check of
every field.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

import roboneuron
from rn_backend_shared.fields import (
    MOST_TEXT,
    array,
    field,
    integer,
    items,
    number,
    numbers,
    optional_number,
    table,
    text,
)
from rn_backend_shared.frames import Document
from rn_backend_shared.images import decode_image
from roboneuron import (
    EE_DELTA,
    ActionChunk,
    Ahead,
    ArmState,
    CameraCalibration,
    CheckpointError,
    ConfigurationError,
    ControlSpace,
    Frame,
    InvalidInputError,
    JointSample,
    MissingDependencyError,
    NotReadyError,
    Observation,
    PluginError,
    Pose,
    RoboNeuronError,
    StateError,
    UngroundedError,
    UnsafeError,
)

_MOST_CAMERAS = 16
_MOST_ARMS = 8
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


def from_observation(observation: Observation) -> Document:
    """Encode an observation, with a context only as the server's reference.

    Raises:
        UnsafeError: a number of its state is not finite.
    """
    joints, pose, ahead = observation.joints, observation.ee_pose, observation.ahead
    _check_finite(observation)
    return {
        "frames": {role: _from_frame(frame) for role, frame in observation.frames.items()},
        "instruction": observation.instruction,
        "joints": None
        if joints is None
        else [list(joints.names), joints.position, joints.velocity, joints.stamp_ns],
        "ee_pose": None if pose is None else _from_pose(pose),
        "gripper_open": observation.gripper_open,
        "arms": {
            name: [_from_pose(arm.ee_pose), arm.gripper_open]
            for name, arm in observation.arms.items()
        },
        "ahead": None if ahead is None else _from_ahead(ahead),
        "stamp_ns": observation.stamp_ns,
    }


def _check_finite(observation: Observation) -> None:
    joints, poses = observation.joints, [arm.ee_pose for arm in observation.arms.values()]
    openings = [observation.gripper_open, *(arm.gripper_open for arm in observation.arms.values())]
    if observation.ee_pose is not None:
        poses.append(observation.ee_pose)
    arrays = [part for pose in poses for part in (pose.position_m, pose.quaternion_xyzw)]
    if joints is not None:
        arrays += (
            [joints.position] if joints.velocity is None else [joints.position, joints.velocity]
        )
    arrays.append(np.array([opening for opening in openings if opening is not None]))
    if not all(np.isfinite(part).all() for part in arrays):
        raise UnsafeError("The observation's state is not finite; it is not sent.")


def _from_pose(pose: Pose) -> list[object]:
    return [pose.position_m, pose.quaternion_xyzw, pose.stamp_ns]


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
        "image": frame.image,
        "stamp_ns": frame.stamp_ns,
        "frame_id": frame.frame_id,
        "calibration": None
        if known is None
        else [known.intrinsics, known.mount, known.T_mount_camera],
    }


def to_observation(document: object, held: Held = lambda context: None) -> Observation:
    """Decode an observation.

    Raises:
        ForeignDataError: a field is missing, or has not the type and range of the contract.
        RoboNeuronError: as the contract's own types.
    """
    frames = table(field(document, "frames"), "frames", _MOST_CAMERAS)
    arms = table(field(document, "arms"), "arms", _MOST_ARMS)
    joints, pose, ahead = (field(document, name) for name in ("joints", "ee_pose", "ahead"))
    return Observation(
        frames={text(role, "a role", 64): _to_frame(frame) for role, frame in frames.items()},
        instruction=text(field(document, "instruction"), "instruction", MOST_TEXT),
        joints=None if joints is None else _to_joints(joints),
        ee_pose=None if pose is None else _to_pose(pose),
        gripper_open=optional_number(field(document, "gripper_open"), "gripper_open"),
        arms={text(name, "an arm", 64): _to_arm(arm) for name, arm in arms.items()},
        ahead=None if ahead is None else _to_ahead(ahead, held),
        stamp_ns=integer(field(document, "stamp_ns"), "stamp_ns"),
    )


def _to_joints(value: object) -> JointSample:
    names, position, velocity, stamp_ns = items(value, "joints", most=4, least=4)
    names = [text(name, "a joint") for name in items(names, "joint names", most=_MOST_NAMES)]
    shape = (len(names),)
    return JointSample(
        names=tuple(names),
        position=numbers(position, "joint positions", shape),
        velocity=None if velocity is None else numbers(velocity, "joint velocities", shape),
        stamp_ns=integer(stamp_ns, "stamp of the joints"),
    )


def _to_pose(value: object) -> Pose:
    position_m, quaternion, stamp_ns = items(value, "a pose", most=3, least=3)
    return Pose(
        position_m=numbers(position_m, "a position", (3,)),
        quaternion_xyzw=numbers(quaternion, "a quaternion", (4,)),
        stamp_ns=integer(stamp_ns, "stamp of a pose"),
    )


def _to_arm(value: object) -> ArmState:
    pose, opening = items(value, "an arm", most=2, least=2)
    return ArmState(ee_pose=_to_pose(pose), gripper_open=optional_number(opening, "an opening"))


def _to_ahead(value: object, held: Held) -> Ahead:
    rows = numbers(field(value, "rows"), "rows ahead", (None, None))
    if len(rows) > MOST_ROWS:
        raise InvalidInputError(f"{len(rows)} rows ahead are more than {MOST_ROWS}.")
    named = field(value, "context")
    context = None
    if named is not None:
        session, count = items(named, "a context", most=2, least=2)
        context = held(HeldContext(integer(session, "a context"), integer(count, "a context")))
    return Ahead(
        rows=rows,
        committed_rows=integer(field(value, "committed_rows"), "committed_rows"),
        step_s=number(field(value, "step_s"), "step_s"),
        context=context,
        context_row=integer(field(value, "context_row"), "context_row"),
        state_ahead_s=number(field(value, "state_ahead_s"), "state_ahead_s"),
    )


def _to_frame(value: object) -> Frame:
    known = field(value, "calibration")
    return Frame(
        camera=text(field(value, "camera"), "camera"),
        image=decode_image(field(value, "image")),
        stamp_ns=integer(field(value, "stamp_ns"), "stamp of an image"),
        frame_id=text(field(value, "frame_id"), "frame_id"),
        calibration=None if known is None else _to_calibration(known),
    )


def _to_calibration(value: object) -> CameraCalibration:
    intrinsics, mount, pose = items(value, "a calibration", most=3, least=3)
    return CameraCalibration(
        intrinsics=numbers(intrinsics, "intrinsics", (3, 3)),
        mount=text(mount, "mount"),
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
        return {
            "error": answer.code,
            "message": answer.message[:MOST_TEXT],
            "hint": answer.hint[:MOST_TEXT],
        }
    return {
        "actions": answer.actions,
        "space": from_space(answer.space),
        "step_s": answer.step_s,
        "metrics": [
            list(answer.metrics),
            np.array(list(answer.metrics.values()), dtype=np.float64),
        ],
        "note": answer.note,
        "context": None if context is None else [context.session, context.number],
        "conditioned_rows": answer.conditioned_rows,
    }


def to_answer(document: Mapping[str, object]) -> ActionChunk:
    """Decode a chunk.

    Raises:
        RoboNeuronError: the received error.
        ForeignDataError: it is neither a chunk nor an error.
    """
    if "error" in document:
        kind = _ERRORS.get(text(document["error"], "an error"), PluginError)
        message = text(field(document, "message"), "a message", MOST_TEXT)
        raise kind(message, hint=text(field(document, "hint"), "a hint", MOST_TEXT))
    names, values = items(field(document, "metrics"), "metrics", most=2, least=2)
    names = [text(name, "a metric", 64) for name in items(names, "metrics", most=_MOST_METRICS)]
    values = array(values, "metrics", "<f8", (len(names),))
    context = field(document, "context")
    return ActionChunk(
        actions=numbers(field(document, "actions"), "actions", (None, None)),
        step_s=number(field(document, "step_s"), "step_s"),
        metrics=dict(zip(names, values.tolist(), strict=True)),
        note=text(field(document, "note"), "a note", MOST_TEXT),
        context=None if context is None else _to_context(context),
        conditioned_rows=integer(field(document, "conditioned_rows"), "conditioned_rows"),
        space=to_space(field(document, "space")),
    )


def _to_context(value: object) -> HeldContext:
    session, count = items(value, "a context", most=2, least=2)
    return HeldContext(integer(session, "a context"), integer(count, "a context"))


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
    kind, rate_hz, channels = items(value, "a space", most=3, least=3)
    named = [
        [text(word, "a channel") for word in items(channel, "a channel", most=4, least=4)]
        for channel in items(channels, "channels", most=_MOST_NAMES)
    ]
    space = ControlSpace(
        kind=text(kind, "kind of a space"),
        channels=tuple(
            roboneuron.Channel(name=name, unit=unit, frame=frame, arm=arm)
            for name, unit, frame, arm in named
        ),
        rate_hz=number(rate_hz, "rate_hz"),
    )
    return EE_DELTA if space == EE_DELTA else space

"""Conversion between vla-eval's conventions for LIBERO and the contract.

Source: vla-eval 0.8.0, benchmarks/libero and model_servers/{openvla,oft}.py. Images come rotated as
in the training data; the state is position [m], rotation vector [rad] and both fingers [m]; actions
are in units of robosuite's OSC_POSE, the gripper -1 open, 1 closed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from roboneuron import Frame, InvalidInputError, JointSample, Observation, Pose

F64 = NDArray[np.float64]

METRES_PER_UNIT, RADIANS_PER_UNIT = 0.05, 0.5
FINGER_TRAVEL_M = 0.04
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
STATE_WIDTH = 8
STAMP_NS = 1


class _State(TypedDict, total=False):
    """Robot state of an observation."""

    joints: JointSample
    ee_pose: Pose
    gripper_open: float


def to_observation(
    payload: Mapping[str, object], roles: Sequence[str], *, needs_state: bool
) -> Observation:
    """Convert a benchmark's payload to an observation.

    Args:
        payload: `images` by name, first the scene camera, then the wrist camera;
            `task_description`; `states`.
        roles: the backend's cameras, in that order.
        needs_state: the backend reads the state.

    Raises:
        InvalidInputError: something that the backend needs is missing or malformed.
    """
    images, instruction = payload.get("images"), payload.get("task_description")
    if not isinstance(images, dict) or len(images) < len(roles):
        has = list(images) if isinstance(images, dict) else images
        raise InvalidInputError(
            f"The observation has the images {has}, expected {len(roles)}: {', '.join(roles)}."
        )
    if not isinstance(instruction, str) or not instruction.strip():
        raise InvalidInputError("The observation has no task_description.")
    frames = {
        role: Frame(
            camera=str(name), image=np.asarray(image), stamp_ns=STAMP_NS, frame_id=f"{name}_optical"
        )
        for role, (name, image) in zip(roles, images.items(), strict=False)
    }
    state: _State = _state(payload) if needs_state else {}
    return Observation(frames=frames, instruction=instruction, stamp_ns=STAMP_NS, **state)


def _state(payload: Mapping[str, object]) -> _State:
    values = np.asarray(payload.get("states", payload.get("state", ())), dtype=np.float64)
    if values.shape != (STATE_WIDTH,) or not np.isfinite(values).all():
        raise InvalidInputError(
            f"The observation's state has the shape {values.shape}, expected 8 finite numbers."
        )
    fingers = values[6:]
    return {
        "joints": JointSample(names=FINGERS, position=fingers, stamp_ns=STAMP_NS),
        "ee_pose": Pose(
            position_m=values[:3], quaternion_xyzw=_quaternion(values[3:6]), stamp_ns=STAMP_NS
        ),
        "gripper_open": float(np.clip(fingers[0] / FINGER_TRAVEL_M, 0.0, 1.0)),
    }


def _quaternion(rotvec_rad: F64) -> F64:
    """Rotation vector (3,) -> quaternion x, y, z, w; its sign tells which of the two equivalent
    vectors it was.
    """
    angle = float(np.linalg.norm(rotvec_rad))
    if angle == 0.0:
        return np.array([0.0, 0.0, 0.0, 1.0])
    return np.concatenate([rotvec_rad / angle * np.sin(angle / 2.0), [np.cos(angle / 2.0)]])


def to_action(vector: F64) -> NDArray[np.float32]:
    """Contract action (7,) -> the benchmark's action, float32 (7,)."""
    motion = np.concatenate([vector[:3] / METRES_PER_UNIT, vector[3:6] / RADIANS_PER_UNIT])
    return np.concatenate([motion, [-np.sign(2.0 * vector[6] - 1.0)]]).astype(np.float32)


def specs(roles: Sequence[str], *, needs_state: bool) -> dict[str, object]:
    """Specification of actions and observations in HELLO."""

    def one(
        name: str, dims: int, form: str, limits: tuple[float, float] | None = None
    ) -> dict[str, object]:
        told: dict[str, object] = {"name": name, "dims": dims, "format": form}
        return told if limits is None else {**told, "range": list(limits)}

    observation = {"language": one("language", 0, "language")}
    if needs_state:
        observation["state"] = one("state", 8, "eef_pos3_axisangle3_gripper2")
    for role, key in (("primary", "agentview"), ("wrist", "wrist")):
        if role in roles:
            observation[key] = one("image", 0, "rgb_hwc_uint8")
    return {
        "action_spec": {
            "position": one("position", 3, "delta_xyz", (-1.0, 1.0)),
            "rotation": one("rotation", 3, "axis_angle", (-3.15, 3.15)),
            "gripper": one("gripper", 1, "binary_close_positive", (-1.0, 1.0)),
        },
        "observation_spec": observation,
        "observation_params": {
            "env_seed": 0,
            "quat_no_antipodal": True,
            "send_wrist_image": "wrist" in roles,
            "send_state": needs_state,
        },
    }

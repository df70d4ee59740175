"""The backend "pi0-remote": asks an openpi policy server."""

from __future__ import annotations

import logging
import os
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rn_backend_pi0.conversion import Conversion, JointConversion
from rn_backend_pi0.image import flip_image, resize_antialiased
from rn_backend_pi0.options import Pi0RemoteOptions
from rn_backend_pi0.wire import Value
from roboneuron import (
    ActionChunk,
    ArmState,
    ConfigurationError,
    Frame,
    JointSample,
    NotReadyError,
    Observation,
    Pose,
    StateError,
    UngroundedError,
    UnsafeError,
)

if TYPE_CHECKING:
    from rn_backend_pi0.client import PolicyClient

_FRESH_S = 0.2
"""When reconnecting took longer than this, the images at hand are old and the caller is asked for
newer ones.
"""
_DOWN_XYZW = (1.0, 0.0, 0.0, 0.0)
log = logging.getLogger(__name__)


class Pi0RemoteBackend:
    """Follows the protocol `Backend`; construction is pure, `load` connects."""

    def __init__(
        self, config: Pi0RemoteOptions, *, runtime: object = None, acceleration: object = None
    ) -> None:
        if runtime is not None or acceleration is not None:
            raise ConfigurationError("Backend 'pi0-remote' takes no runtime and no acceleration.")
        self._config = config
        self._client: PolicyClient | None = None
        self._conversion: Conversion | None = None
        self._warning = ""

    def load(self) -> None:
        """Connect, and ask for one chunk, so that the server has compiled and its answer is known
        to fit.

        Raises:
            ConfigurationError: an option does not fit, the key is refused, or the server's answer
                does not fit.
            NotReadyError: the server cannot be reached in time or fails.
            UnsafeError: the server's model produces non-finite values.
            StateError: it is loaded already.
        """
        if self._client is not None:
            raise StateError(
                "Backend 'pi0-remote' is connected already.", hint="Call close() first."
            )
        from rn_backend_pi0.client import PolicyClient, check_url  # heavy

        config = self._config
        conversion = config.resolve_conversion(served=True)
        if config.joint_key is not None and not isinstance(conversion, JointConversion):
            raise ConfigurationError(
                "joint_key has no use: the profile moves the TCP.",
                hint="Remove joint_key and gripper_key.",
            )
        if config.profile == "libero-openpi":
            raise ConfigurationError(
                "Profile 'libero-openpi' adds the state to the actions, which openpi's server has "
                "done already.",
                hint="Use profile 'libero'.",
            )
        key = self._read_key()
        self._warning = check_url(
            config.url, has_key=key is not None, allow_insecure_key=config.allow_insecure_key
        )
        if self._warning:
            log.warning("%s", self._warning)
        with ExitStack() as undo:
            client = PolicyClient(config.url, api_key=key)
            undo.callback(client.close)
            metadata = client.open(config.connect_timeout_s)
            log.info("policy server at %s says %s", config.url, metadata)
            request, _ = self._request(_nominal(config, conversion), conversion)
            width = len(conversion.action_columns)
            raw = _actions(client.infer(request, config.warm_up_timeout_s), width)
            if config.action_steps is not None and config.action_steps > len(raw):
                raise ConfigurationError(
                    f"action_steps is {config.action_steps}, the server yields {len(raw)} actions."
                )
            if not np.isfinite(raw).all():
                raise UnsafeError("The policy server answered the warm-up with non-finite values.")
            undo.pop_all()
        self._client, self._conversion = client, conversion

    def predict(self, observation: Observation) -> ActionChunk:
        """Return the next actions.

        Raises:
            NotReadyError: no answer in time, or the connection is gone; the next call connects
                again.
            UngroundedError: a camera, the pose, joints or the gripper is missing.
            UnsafeError: the measured state or the answer is not finite.
            ConfigurationError: the answer is not what the protocol and the profile say.
            StateError: `load` was not called.
        """
        client, conversion, config = self._client, self._conversion, self._config
        if client is None or conversion is None:
            raise StateError("Backend 'pi0-remote' is not loaded; call load() first.")
        start = time.monotonic()
        request, state = self._request(observation, conversion)
        if not client.is_connected:
            client.open(config.request_timeout_s)
            if time.monotonic() - start > _FRESH_S:
                raise NotReadyError(
                    f"Connected to {config.url} again; the observation has grown old meanwhile."
                )
        reply = client.infer(request, config.request_timeout_s - (time.monotonic() - start))
        raw = _actions(reply, len(conversion.action_columns))[: config.action_steps]
        actions = conversion.to_contract(raw, state, observation)
        metrics = {
            "inference_ms": (time.monotonic() - start) * 1e3,
            "chunk_horizon": float(len(actions)),
            "cameras": float(len(config.image_keys)),
            "connections": float(client.connections),
        }
        server_ms = _server_ms(reply)
        if server_ms is not None:
            metrics["server_ms"] = server_ms
        return ActionChunk(
            actions=actions,
            step_s=conversion.step_s,
            space=conversion.space,
            metrics=metrics,
            note=self._warning,
        )

    def reset(self) -> None:
        """Nothing to forget: the server keeps no episode."""

    def close(self) -> None:
        """Disconnect."""
        if self._client is not None:
            self._client.close()
        self._client = self._conversion = None

    def _read_key(self) -> str | None:
        name = self._config.api_key_variable
        if name is None:
            return None
        key = os.environ.get(name, "").strip()
        if not key:
            raise ConfigurationError(
                f"The environment variable {name!r} (api_key_variable) is not set."
            )
        return key

    def _request(
        self, observation: Observation, conversion: Conversion
    ) -> tuple[dict[str, Value], NDArray[np.float64]]:
        """The request's map, and the state in it."""
        config = self._config
        state = conversion.read_state(observation)
        request: dict[str, Value] = {config.prompt_key: observation.instruction}
        if config.joint_key is None or config.gripper_key is None:
            request[config.state_key] = state
        else:
            is_gripper = np.array([column == "gripper" for column in conversion.state_columns])
            request |= {config.joint_key: state[~is_gripper], config.gripper_key: state[is_gripper]}
        for role, key in config.image_keys.items():
            frame = observation.frames.get(role)
            if frame is None:
                have = ", ".join(observation.frames) or "none"
                raise UngroundedError(
                    f"The policy server needs a frame of the camera role {role!r}; the "
                    f"observation has: {have}.",
                    hint="Remove the role from image_keys if the served model does without.",
                )
            turned = flip_image(frame.image, config.image_flip)
            request[key] = np.ascontiguousarray(resize_antialiased(turned, config.image_side_px))
        return request, state


def _nominal(config: Pi0RemoteOptions, conversion: Conversion) -> Observation:
    """A harmless observation for the warm-up; its answer is checked and thrown away."""
    side = config.image_side_px
    grey = np.full((side, side, 3), 128, dtype=np.uint8)
    names = conversion.measured_joints
    pose = Pose(position_m=np.array([0.45, 0.0, 0.45]), quaternion_xyzw=np.array(_DOWN_XYZW))
    arms = {channel.arm for channel in conversion.space.channels} - {""}
    return Observation(
        frames={
            role: Frame(camera=role, image=grey, stamp_ns=0, frame_id=role)
            for role in config.image_keys
        },
        instruction="warm up",
        joints=JointSample(names=names, position=np.zeros(len(names))),
        ee_pose=pose,
        gripper_open=0.5,
        arms={arm: ArmState(ee_pose=pose, gripper_open=0.5) for arm in arms},
    )


def _actions(reply: dict[object, object], width: int) -> NDArray[np.float64]:
    """float64 (H, width) of a reply. Raises ConfigurationError for anything else; non-finite values
    are left to others.
    """
    actions = reply.get("actions")
    if not isinstance(actions, np.ndarray):
        raise ConfigurationError(
            "The policy server's reply has no array 'actions'; its keys: "
            f"{sorted(map(str, reply))}."
        )
    if actions.ndim != 2 or actions.shape[0] < 1 or actions.shape[1] != width:
        raise ConfigurationError(
            f"The policy server yields actions of shape {actions.shape}, expected (H >= 1, "
            f"{width}).",
            hint="Choose the profile of the served policy.",
        )
    return actions.astype(np.float64)


def _server_ms(reply: dict[object, object]) -> float | None:
    """The server's own inference time, when it says one."""
    for block in ("policy_timing", "server_timing"):
        timing = reply.get(block)
        if isinstance(timing, dict):
            value = timing.get("infer_ms")
            if isinstance(value, int | float) and np.isfinite(value):
                return float(value)
    return None

"""A policy that is asked in a profile's interface, of any server of openpi's websocket."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rn_backend_openpi.description import ServerDescription, agreed, is_arena
from rn_backend_openpi.interface import engine_layout
from rn_backend_openpi.layout import Layout
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.plugin import MOST_ROWS
from rn_backend_openpi.session import Reply, Request
from roboneuron import (
    ActionChunk,
    ArmState,
    ConfigurationError,
    ForeignDataError,
    Frame,
    JointSample,
    Observation,
    Pose,
    UnsafeError,
    foreign,
)

Exchange = Callable[[Request, float], Reply]
"""Sends a request and returns the reply until a deadline (monotonic [s])."""
_ENVELOPE = "action.generation"
_DOWN_XYZW = (1.0, 0.0, 0.0, 0.0)
_GREY_PX = (224, 224)


class ProfilePolicy:
    """Requests and replies in the interface of a profile.

    Args:
        options: with a profile.

    Raises:
        ConfigurationError: an option does not fit.
        CheckpointError: the statistics of an engine's checkpoint cannot be read.
    """

    def __init__(self, options: PolicyOptions) -> None:
        self._options = options
        self._layout = engine_layout(options)
        self._is_arena = False
        self._episode, self._is_new = uuid.uuid4().hex, False

    def agree(self, description: ServerDescription) -> None:
        """Compare the server's description with the options. Raises as `agreed`."""
        is_set = self._options.image_size_px is not None
        self._layout = agreed(description, self._layout, is_size_set=is_set)
        dialect = self._options.dialect
        self._is_arena = dialect == "roboarena" or (dialect == "auto" and is_arena(description))

    def warm_up(self, exchange: Exchange) -> None:
        """Request one chunk, so that the server compiles its model and the format is checked."""
        until_s = time.monotonic() + self._options.warm_up_timeout_s
        self.ask(_nominal(self._options, self._layout), exchange, until_s)

    def begin_episode(self) -> None:
        """A server with episodes is told with the next request."""
        self._episode, self._is_new = uuid.uuid4().hex, True

    def ask(self, observation: Observation, exchange: Exchange, deadline_s: float) -> ActionChunk:
        """Send one request and check its answer.

        Raises:
            UngroundedError: a camera, the pose, joints or the gripper is missing.
            UnsafeError: the measured state or the answer is not finite.
            ConfigurationError: the answer does not follow the protocol or the profile.
            NotReadyError: as `exchange`.
        """
        layout, start_s = self._layout, time.monotonic()
        request = layout.request_of(observation)
        if self._is_arena:
            named = {"session_id": self._episode}
            if self._is_new:
                exchange({"endpoint": "reset", **named}, deadline_s)
                self._is_new = False
            request |= {"endpoint": "infer", **named}
        reply = exchange(request, deadline_s)
        served = self._served(reply, layout.served_width)
        metrics = {
            "inference_ms": (time.monotonic() - start_s) * 1e3,
            "chunk_horizon": float(len(served)),
            "cameras": float(len(layout.image_keys)),
        }
        server_ms = _server_ms(reply)
        if server_ms is not None:
            metrics["server_ms"] = server_ms
        return ActionChunk(
            actions=layout.rows_of(served, observation),
            step_s=layout.rows.step_s,
            space=layout.rows.space,
            metrics=metrics,
        )

    def _served(self, reply: Reply, width: int) -> NDArray[np.float64]:
        """The served actions of a reply, float64 (H, width).

        Raises:
            ConfigurationError: the reply has another form; names both sides.
            UnsafeError: a value is not finite.
        """
        config = self._options
        values = _side_by_side(reply, config.action_keys)
        if values.ndim != 2 or not len(values) or values.shape[1] != width:
            raise ConfigurationError(
                f"The policy server yields actions of shape {values.shape}, expected (H >= 1, "
                f"{width}).",
                hint="Choose the profile of the served policy.",
            )
        steps = config.action_steps
        if steps is not None and steps > len(values):
            raise ConfigurationError(
                f"action_steps is {steps}, the server yields {len(values)} actions."
            )
        if steps is None and len(values) > MOST_ROWS:
            raise ConfigurationError(
                f"The server yields {len(values)} actions, at most {MOST_ROWS} are taken.",
                hint="Set action_steps.",
            )
        if not np.isfinite(values).all():
            raise UnsafeError("The policy server answered with non-finite values.")
        return values[:steps]


def _side_by_side(reply: Reply, keys: tuple[str, ...]) -> NDArray[np.float64]:
    """Concatenate the arrays of these keys, float64; a bare array stands for that of a single key.

    Raises:
        ConfigurationError: one of them is missing, or their shapes do not fit.
    """
    if isinstance(reply, np.ndarray):
        if len(keys) > 1:
            raise ConfigurationError(
                f"The policy server's reply is an array, action_keys names {', '.join(keys)}.",
                hint="Leave action_keys out.",
            )
        return _chunk(reply)
    if reply.get("object") == _ENVELOPE:
        return _chunk(_enclosed(reply))
    parts = []
    for key in keys:
        part = reply.get(key)
        if not isinstance(part, np.ndarray):
            raise ConfigurationError(
                f"The policy server's reply has no array {key!r}; its keys: "
                f"{sorted(map(str, reply))}.",
                hint="Correct action_keys.",
            )
        parts.append(_chunk(part))
    if len(parts) == 1:
        return parts[0]
    if any(part.ndim != 2 or len(part) != len(parts[0]) for part in parts):
        shapes = ", ".join(f"{key} {part.shape}" for key, part in zip(keys, parts, strict=True))
        raise ConfigurationError(f"The policy server's arrays do not fit together: {shapes}.")
    return np.hstack(parts)


def _enclosed(reply: dict[object, object]) -> NDArray[np.generic]:
    """The rows in an envelope of SGLang's /v1/actions/realtime. Raises ConfigurationError."""
    try:
        first = foreign.items(foreign.field(reply, "data"), "data", most=MOST_ROWS, least=1)[0]
        values = foreign.field(foreign.field(first, "action"), "values")
    except ForeignDataError as error:
        raise ConfigurationError(f"The policy server's envelope holds no rows: {error}.") from error
    if not isinstance(values, np.ndarray):
        raise ConfigurationError("The policy server's envelope holds no array of rows.")
    return values


def _chunk(values: NDArray[np.generic]) -> NDArray[np.float64]:
    """Remove the axis of a batch of one, which some servers keep."""
    numbers = values.astype(np.float64)
    return numbers[0] if numbers.ndim == 3 and len(numbers) == 1 else numbers


def _nominal(options: PolicyOptions, layout: Layout) -> Observation:
    """A harmless observation for the warm-up; its answer is checked and discarded."""
    grey = np.full((*(layout.image_size_px or _GREY_PX), 3), 128, dtype=np.uint8)
    names = options.joints or ()
    pose = Pose(position_m=np.array([0.45, 0.0, 0.45]), quaternion_xyzw=np.array(_DOWN_XYZW))
    arms = {channel.arm for channel in layout.rows.space.channels} - {""}
    return Observation(
        frames={
            role: Frame(camera=role, image=grey, stamp_ns=0, frame_id=role)
            for role in layout.image_keys
        },
        instruction="warm up",
        joints=JointSample(names=names, position=np.zeros(len(names))),
        ee_pose=pose,
        gripper_open=0.5,
        arms={arm: ArmState(ee_pose=pose, gripper_open=0.5) for arm in sorted(arms)},
    )


def _server_ms(reply: Reply) -> float | None:
    """The server's own inference time [ms]; None if the reply has none."""
    if not isinstance(reply, dict):
        return None
    for block in ("policy_timing", "server_timing"):
        timing = reply.get(block)
        if isinstance(timing, dict):
            value = timing.get("infer_ms")
            if isinstance(value, int | float | np.number) and np.isfinite(value):
                return float(value)
    return None

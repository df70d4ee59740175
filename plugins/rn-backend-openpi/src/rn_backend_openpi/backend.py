"""The backend "openpi": a client of a policy server."""

from __future__ import annotations

import logging
import os
import time
import uuid
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rn_backend_openpi import metadata
from rn_backend_openpi.engines import for_engine, url_of
from rn_backend_openpi.interface import layout_of
from rn_backend_openpi.layout import STEP, Layout
from rn_backend_openpi.messages import RESERVED
from rn_backend_openpi.metadata import Told
from rn_backend_openpi.options import OpenpiOptions
from rn_backend_openpi.plugin import MOST_ROWS
from rn_backend_openpi.security import check_url, read_token
from roboneuron import (
    ActionChunk,
    ArmState,
    Backend,
    ConfigurationError,
    ForeignDataError,
    Frame,
    JointSample,
    NotReadyError,
    Observation,
    Pose,
    StateError,
    UnsafeError,
    foreign,
)

if TYPE_CHECKING:
    from rn_backend_openpi.client import PolicyClient, Reply

_FRESH_S = 0.2
"""Reconnecting time above which the current images are too old, so that the caller must send newer
ones.
"""
_ENVELOPE = "action.generation"
_DOWN_XYZW = (1.0, 0.0, 0.0, 0.0)
_GREY_PX = (224, 224)
log = logging.getLogger(__name__)


@dataclass(slots=True)
class _OpenpiSession:
    """State of a loaded backend.

    Attributes:
        client: connected, or reconnecting.
        told: the server's metadata.
        warning: shown in every chunk; empty for none.
        identity: id of the episode, for servers that use one.
        is_new: True until the server has been notified of the new episode.
    """

    client: PolicyClient
    told: Told
    warning: str
    identity: str
    is_new: bool = False


class OpenpiBackend:
    """Implements the protocol `Backend`; the constructor has no side effects, `load` connects."""

    def __init__(
        self, config: OpenpiOptions, *, runtime: object = None, acceleration: object = None
    ) -> None:
        if runtime is not None or acceleration is not None:
            raise ConfigurationError("Backend 'openpi' takes no runtime and no acceleration.")
        self._config = config
        self._session: _OpenpiSession | None = None

    def load(self) -> None:
        """Connect, compare the server's metadata with the options, and request one chunk, so that
        the server compiles its model and the answer's format is checked.

        Raises:
            ConfigurationError: an option does not fit, the key is refused, or the server's metadata
                or answer do not fit.
            NotReadyError: the server cannot be reached in time or fails.
            UnsafeError: the server's model produces non-finite values.
            StateError: the backend is already loaded.
        """
        if self._session is not None:
            raise StateError("Backend 'openpi' is connected already.", hint="Call close() first.")
        from rn_backend_openpi.client import PolicyClient  # heavy

        config = self._config
        layout, url = for_engine(layout_of(config), config), url_of(config)
        key = self._read_key()
        warning = check_url(
            url, has_key=key is not None, allow_insecure_key=config.allow_insecure_key
        )
        if warning:
            log.warning("%s", warning)
        with ExitStack() as undo:
            client = PolicyClient(url, api_key=key, ca_file=config.ca_file)
            undo.callback(client.close)
            first = client.open(config.connect_timeout_s)
            log.info("policy server at %s says %s", url, first)
            told = metadata.check(
                first,
                layout,
                size_is_set=config.image_size_px is not None,
                dialect=config.dialect,
            )
            session = _OpenpiSession(client, told, warning, uuid.uuid4().hex)
            self._ask(session, _nominal(config, told.layout), config.warm_up_timeout_s)
            undo.pop_all()
        self._session = session

    def predict(self, observation: Observation) -> ActionChunk:
        """Return the next actions.

        Raises:
            NotReadyError: no answer in time, or the connection is lost; the next call reconnects.
            UngroundedError: a camera, the pose, joints or the gripper is missing.
            UnsafeError: the measured state or the answer is not finite.
            ConfigurationError: the answer does not follow the protocol or the profile.
            StateError: `load` was not called.
        """
        session, config = self._session, self._config
        if session is None:
            raise StateError("Backend 'openpi' is not loaded; call load() first.")
        start = time.monotonic()
        if not session.client.is_connected:
            session.client.open(config.request_timeout_s)
            if time.monotonic() - start > _FRESH_S:
                raise NotReadyError(
                    f"Reconnected to {config.url}; the observation is too old by now."
                )
        left_s = config.request_timeout_s - (time.monotonic() - start)
        return self._ask(session, observation, left_s)

    def reset(self) -> None:
        """Start a new episode; a server with sessions is notified with the next request."""
        if self._session is not None:
            self._session.identity = uuid.uuid4().hex
            self._session.is_new = True

    def close(self) -> None:
        """Disconnect."""
        session, self._session = self._session, None
        if session is not None:
            session.client.close()

    def _read_key(self) -> str | None:
        config = self._config
        if config.api_key_file is not None:
            return read_token(config.api_key_file)
        if config.api_key_variable is None:
            return None
        key = os.environ.get(config.api_key_variable, "").strip()
        if not key:
            raise ConfigurationError(
                f"The environment variable {config.api_key_variable!r} (api_key_variable) is not "
                "set."
            )
        return key

    def _ask(
        self, session: _OpenpiSession, observation: Observation, timeout_s: float
    ) -> ActionChunk:
        """Send one request and check its answer."""
        told, client = session.told, session.client
        rows = told.layout.rows
        start = time.monotonic()
        request = told.layout.request_of(observation)
        if told.is_roboarena:
            self._begin(session, timeout_s)
            request |= {"endpoint": "infer", "session_id": session.identity}
        left_s = timeout_s - (time.monotonic() - start)
        if told.is_roboneuron:
            request[RESERVED] = {"left_s": max(left_s, 0.0)}
        reply = client.infer(request, left_s)
        served = self._served(reply, told.layout.served_width)
        metrics = {
            "inference_ms": (time.monotonic() - start) * 1e3,
            "chunk_horizon": float(len(served)),
            "cameras": float(len(told.layout.image_keys)),
            "connections": float(client.connections),
        }
        server_ms = _server_ms(reply)
        if server_ms is not None:
            metrics["server_ms"] = server_ms
        return ActionChunk(
            actions=told.layout.rows_of(served, observation),
            step_s=rows.step_s or _step_s(reply),
            space=rows.space,
            metrics=metrics,
            note=session.warning,
        )

    def _begin(self, session: _OpenpiSession, timeout_s: float) -> None:
        """Notify the server of a new episode, once."""
        if session.is_new:
            session.client.reset({"endpoint": "reset", "session_id": session.identity}, timeout_s)
            session.is_new = False

    def _served(self, reply: Reply, width: int) -> NDArray[np.float64]:
        """The served actions of a reply, float64 (H, width).

        Raises:
            ConfigurationError: the reply has another form; names both sides.
            UnsafeError: a value is not finite.
        """
        config = self._config
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


def _nominal(config: OpenpiOptions, layout: Layout) -> Observation:
    """A harmless observation for the warm-up; its answer is checked and discarded."""
    grey = np.full((*(layout.image_size_px or _GREY_PX), 3), 128, dtype=np.uint8)
    names = config.joints or ()
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


def _step_s(reply: Reply) -> float:
    """Time between two actions, from the reply [s]. Raises ConfigurationError if it has none."""
    step_s = reply.get(STEP) if isinstance(reply, dict) else None
    if not isinstance(step_s, int | float) or not 0.0 < step_s <= 10.0:
        raise ConfigurationError(
            f"The policy server's reply has no time between two actions ({STEP} is {step_s!r}).",
            hint="Set rate_hz.",
        )
    return float(step_s)


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


if TYPE_CHECKING:
    _: type[Backend] = OpenpiBackend

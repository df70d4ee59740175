"""Strict stand-ins for the policy endpoints of openpi, SGLang and vLLM-Omni, written from their
public definitions (named in `rn_backend_openpi.profiles`) without the code under test.

The last two serve a LeRobot checkpoint in its own units: state and rows are normalised, rows are
padded to 32 values, an unknown camera is ignored and computed as black.
"""

from __future__ import annotations

import ssl
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray
from openpi_format import decode, encode
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection, serve

from rn_testing.waiting import wait_until

PADDED = 32
CAMERAS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
PREFIX = "observation.images."
Policy = Callable[[dict[str, NDArray[np.uint8]], NDArray[np.float32], str], NDArray[np.float64]]
"""Images by camera, the state, the instruction; rows (H, n) in the network's units."""


class StandIn:
    """A policy server at a free loopback port: metadata first, then `answer` for each message.

    Attributes:
        path: of its websocket; others are answered with HTTP 404. Empty: any.
        requests: the newest ones.
        held: while it is not set, no request is answered.
    """

    path = ""

    def __init__(self) -> None:
        self.requests: deque[dict[Any, Any]] = deque(maxlen=8)  # images are large
        self.connections: list[ServerConnection] = []
        self.held = threading.Event()
        self.held.set()
        self.tls: ssl.SSLContext | None = None
        self.port = 0
        self._server: Server | None = None

    @property
    def url(self) -> str:
        return f"{'wss' if self.tls else 'ws'}://127.0.0.1:{self.port}"

    def start(self) -> None:
        """Listen; the second time on the same port."""
        options = {"compression": None, "max_size": None, "close_timeout": 0.2, "ssl": self.tls}
        wait_until(lambda: self._listens(options), 5.0, "the port is free again")

    def _listens(self, options: dict[str, Any]) -> bool:
        place = ("127.0.0.1", self.port)
        try:
            self._server = serve(self._handle, *place, process_request=self._process, **options)
        except OSError:
            return False
        self.port = self._server.socket.getsockname()[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return True

    def stop(self) -> None:
        """Stop listening and cut every connection, like a killed process."""
        self.held.set()
        if self._server is not None:
            self._server.shutdown()
            self._server = None
        self.cut()

    def cut(self) -> None:
        """Cut every connection without a closing handshake."""
        for connection in self.connections:
            with suppress(OSError):
                connection.socket.shutdown(2)
        self.connections.clear()

    def _process(self, connection: ServerConnection, request: Any) -> Any:
        is_here = self.path in ("", request.path)
        return None if is_here else connection.respond(404, "Not Found\n")

    def _handle(self, connection: ServerConnection) -> None:
        self.connections.append(connection)
        with suppress(ConnectionClosed):
            self.greet()
            connection.send(self.packed(self.metadata))
            while True:
                self.answer(connection, connection.recv())

    def greet(self) -> None:
        """Called before the metadata are sent."""

    @property
    def metadata(self) -> Any:
        raise NotImplementedError

    def answer(self, connection: ServerConnection, data: str | bytes) -> None:
        raise NotImplementedError

    def fail(self, connection: ServerConnection, error: Exception) -> None:
        """Send a traceback and close, as openpi does."""
        connection.send(
            f"Traceback (most recent call last):\n  ...\n{type(error).__name__}: {error}\n"
        )
        connection.close(1011, "Internal server error. Traceback included in previous frame.")

    @staticmethod
    def packed(value: Any) -> Any:
        """A message; bytes and text are sent unchanged."""
        return value if isinstance(value, bytes | str) else msgpack.packb(value, default=encode)


class ScriptedServer(StandIn):
    """openpi's server with scripted answers.

    `reply` gets each request and returns the reply; it may raise ValueError, return bytes or text
    to be sent unchanged, or None for nothing.
    """

    def __init__(self) -> None:
        super().__init__()
        self.reply: Callable[[dict[Any, Any]], Any] = lambda request: {"actions": np.zeros((10, 7))}
        self.told: Any = {"policy": "stand-in"}
        self.wait: Callable[[], object] = lambda: None

    @property
    def metadata(self) -> Any:
        return self.told

    def greet(self) -> None:
        self.wait()

    def answer(self, connection: ServerConnection, data: str | bytes) -> None:
        self.requests.append(msgpack.unpackb(data, object_hook=decode))
        try:
            reply = self.reply(self.requests[-1])
        except ValueError as error:
            self.fail(connection, error)
            return
        if reply is not None:
            connection.send(self.packed(reply))


class EngineStandIn(StandIn):
    """A server of a network.

    Args:
        policy: the network.
    """

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy = policy

    def actions(
        self, images: dict[str, NDArray[np.uint8]], state: Any, prompt: str
    ) -> NDArray[np.float32]:
        """The padded rows; raises ValueError for what the engine refuses."""
        for image in images.values():
            if not isinstance(image, np.ndarray) or image.ndim != 3 or image.shape[-1] != 3:
                raise ValueError("Could not infer image channels")
        vector = np.asarray(state, dtype=np.float32)
        if vector.ndim != 1 or len(vector) > PADDED:
            raise ValueError(f"Pi05 state dim must be <= {PADDED}, got {vector.shape}")
        self.held.wait(60.0)
        rows = self.policy(images, vector, prompt)
        padded = np.zeros((len(rows), PADDED), dtype=np.float32)
        padded[:, : rows.shape[1]] = rows
        return padded


class SglangStandIn(EngineStandIn):
    """SGLang's pi0.5: `/openpi/policy`, or the envelopes of `/v1/actions/realtime`.

    An error is a map with a traceback, after which it closes with 1011.
    """

    def __init__(self, policy: Policy, path: str = "/openpi/policy") -> None:
        super().__init__(policy)
        self.path = path

    @property
    def metadata(self) -> dict[str, Any]:
        return {
            "object": "action.metadata",
            "model": "lerobot/pi05_base",
            "policy_family": "pi05",
            "input": {"image_keys": list(CAMERAS), "image_size": [224, 224], "state_dim": PADDED},
            "output": {
                "action_type": "continuous",
                "action_horizon": 50,
                "action_dim": PADDED,
                "padded_action_dim": PADDED,
                "dtype": "float32",
            },
            "capabilities": {"openpi_websocket": True, "batch_inputs": False},
        }

    def answer(self, connection: ServerConnection, data: str | bytes) -> None:
        try:
            request = msgpack.unpackb(data, object_hook=decode)
            self.requests.append(request)
            images = {
                camera: request[PREFIX + camera] for camera in CAMERAS if PREFIX + camera in request
            }
            prompt = request.get("prompt") or request.get("task") or ""
            rows = self.actions(images, request.get("observation.state"), prompt)
        except Exception as error:
            told = f"Traceback (most recent call last):\n  ...\n{type(error).__name__}: {error}\n"
            connection.send(self.packed({"error": told}))
            connection.close(1011, "Internal server error")
            return
        timing = {"infer_ms": 43.0}
        if self.path == "/openpi/policy":
            connection.send(self.packed({"actions": rows, "server_timing": timing}))
            return
        action = {"type": "continuous", "dtype": "float32", "shape": list(rows.shape)}
        connection.send(
            self.packed(
                {
                    "object": "action.generation",
                    "data": [{"index": 0, "action": {**action, "values": rows}}],
                    "server_timing": timing,
                }
            )
        )


class VllmOmniStandIn(EngineStandIn):
    """vLLM-Omni's pi0. An error is a map that names no cause; the connection stays."""

    path = "/v1/realtime/robot/openpi"

    @property
    def metadata(self) -> dict[str, Any]:
        return {
            "image_resolution": [224, 224],
            "n_external_cameras": 1,
            "needs_wrist_camera": True,
            "needs_stereo_camera": False,
            "needs_session_id": False,
            "action_space": "joint_position",
            "action_horizon": 50,
            "action_dim": PADDED,
            "max_cameras": 3,
        }

    def answer(self, connection: ServerConnection, data: str | bytes) -> None:
        request = msgpack.unpackb(data, object_hook=decode)
        self.requests.append(request)
        if request.pop("endpoint", "infer") == "reset":
            connection.send(self.packed({"status": "reset successful"}))
            return
        try:
            images = {
                camera: request[PREFIX + camera] for camera in CAMERAS if PREFIX + camera in request
            }
            rows = self.actions(images, request["state"], request.get("prompt", ""))
        except Exception:
            told = {"type": "error", "message": "Internal inference error"}
            connection.send(self.packed(told))
            return
        connection.send(self.packed(rows))


class OpenpiStandIn(EngineStandIn):
    """openpi, which serves a robot's own units and keys. An error is a traceback as text, after
    which it closes with 1011.
    """

    path = "/"

    @property
    def metadata(self) -> dict[str, Any]:
        return {}

    def answer(self, connection: ServerConnection, data: str | bytes) -> None:
        try:
            request = msgpack.unpackb(data, object_hook=decode)
            self.requests.append(request)
            images = {CAMERAS[0]: request["observation/image"]}
            self.held.wait(60.0)
            rows = self.policy(images, request["observation/state"], request["prompt"])
        except Exception as error:
            self.fail(connection, error)
            return
        connection.send(self.packed({"actions": rows, "policy_timing": {"infer_ms": 40.0}}))

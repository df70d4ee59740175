"""Strict stand-ins for the policy endpoints of openpi, SGLang and vLLM-Omni, written from their
public definitions (named in `rn_backend_openpi.engines`) without the code under test.

The last two serve a LeRobot checkpoint in its own units: state and rows are normalised, rows are
padded to 32 values, an unknown camera is ignored and computed as black.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray
from openpi_format import decode, encode
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection, serve

PADDED = 32
CAMERAS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
PREFIX = "observation.images."
Policy = Callable[[dict[str, NDArray[np.uint8]], NDArray[np.float32], str], NDArray[np.float64]]
"""Images by camera, the state, the instruction; rows (H, n) in the network's units."""


class EngineStandIn:
    """A server at a free loopback port.

    Args:
        policy: the served network.
        path: of its websocket; others are answered with HTTP 404.
    """

    path = ""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self.requests: list[dict[Any, Any]] = []
        self.connections: list[ServerConnection] = []
        self.held = threading.Event()
        self.held.set()
        self._server: Server | None = None
        self.port = 0

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    def start(self) -> None:
        """Listen; the second time on the same port."""
        self._server = serve(
            self._handle,
            "127.0.0.1",
            self.port,
            compression=None,
            max_size=None,
            process_request=self._process,
        )
        self.port = self._server.socket.getsockname()[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def stop(self) -> None:
        """Cut every connection and stop listening, like a killed process."""
        self.held.set()
        if self._server is not None:
            self._server.shutdown()
            self._server = None
        for connection in self.connections:
            with suppress(OSError):
                connection.socket.shutdown(2)
        self.connections.clear()

    def _process(self, connection: ServerConnection, request: Any) -> Any:
        return None if request.path == self.path else connection.respond(404, "Not Found\n")

    def _handle(self, connection: ServerConnection) -> None:
        self.connections.append(connection)
        try:
            connection.send(self.packed(self.metadata()))
            while True:
                self.answer(connection, connection.recv())
        except ConnectionClosed:
            return

    def metadata(self) -> dict[str, Any]:
        raise NotImplementedError

    def answer(self, connection: ServerConnection, data: str | bytes) -> None:
        raise NotImplementedError

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

    @staticmethod
    def packed(value: Any) -> bytes:
        packed: bytes = msgpack.packb(value, default=encode)
        return packed


class SglangStandIn(EngineStandIn):
    """SGLang's pi0.5: `/openpi/policy`, or the envelopes of `/v1/actions/realtime`.

    An error is a map with a traceback, after which it closes with 1011.
    """

    def __init__(self, policy: Policy, path: str = "/openpi/policy") -> None:
        super().__init__(policy)
        self.path = path

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
            if isinstance(data, str):
                raise KeyError("bytes")
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
        if isinstance(data, str):
            return
        try:
            request = msgpack.unpackb(data, object_hook=decode)
            if not isinstance(request, dict):
                raise TypeError("no map")
        except Exception:
            self._fail(connection, "Invalid request payload")
            return
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
            self._fail(connection, "Internal inference error")
            return
        connection.send(self.packed(rows))

    def _fail(self, connection: ServerConnection, message: str) -> None:
        connection.send(self.packed({"type": "error", "message": message}))


class OpenpiStandIn(EngineStandIn):
    """openpi, which serves a robot's own units and keys. An error is a traceback as text, after
    which it closes with 1011.
    """

    path = "/"

    def metadata(self) -> dict[str, Any]:
        return {}

    def answer(self, connection: ServerConnection, data: str | bytes) -> None:
        try:
            if isinstance(data, str):
                raise TypeError("no bytes")
            request = msgpack.unpackb(data, object_hook=decode)
            self.requests.append(request)
            images = {CAMERAS[0]: request["observation/image"]}
            self.held.wait(60.0)
            rows = self.policy(images, request["observation/state"], request["prompt"])
        except Exception as error:  # as openpi does
            told = f"Traceback (most recent call last):\n  ...\n{type(error).__name__}: {error}\n"
            connection.send(told)
            connection.close(1011, "Internal server error. Traceback included in previous frame.")
            return
        connection.send(self.packed({"actions": rows, "policy_timing": {"infer_ms": 40.0}}))

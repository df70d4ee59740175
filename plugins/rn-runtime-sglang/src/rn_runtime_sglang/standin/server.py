"""The stand-in server: checks requests like SGLang, and sends replies with the recorded shapes."""

from __future__ import annotations

import base64
import json
import socket
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from rn_runtime_sglang.standin.replies import (
    Behaviour,
    Fault,
    expected_tokens,
    generate_reply,
    metrics_text,
    model_info,
    request_problem,
    server_info,
)


@dataclass
class ReceivedRequests:
    """Received requests: ids of the requests for tokens and of the aborts, and the last body."""

    generated: list[str] = field(default_factory=list)
    aborted: list[str] = field(default_factory=list)
    body: dict[str, object] = field(default_factory=dict)
    body_bytes: int = 0


class StandInServer:
    """Runs on threads of this process from `start` to `stop`."""

    def __init__(self, behaviour: Behaviour, port: int = 0) -> None:
        self.behaviour = behaviour
        self.seen = ReceivedRequests()
        self.released = threading.Event()
        self._aborts: dict[str, threading.Event] = {}
        self._port = port
        self._http: _Http | None = None
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> int:
        """Port that it listens on, once started."""
        return self._port

    @property
    def url(self) -> str:
        """Its address."""
        return f"http://127.0.0.1:{self._port}"

    def start(self) -> StandInServer:
        """Start listening; on the same port again after a `stop`."""
        self.released.clear()
        self._http = _Http(("127.0.0.1", self._port), _StandInHandler)
        self._http.owner = self
        self._port = self._http.server_address[1]
        self._thread = threading.Thread(
            target=self._http.serve_forever, args=(0.02,), name="stand-in", daemon=True
        )
        self._thread.start()
        return self

    def stop(self) -> None:
        """Close all connections at once, like a killed process."""
        self.released.set()
        if self._http is not None:
            self._http.shutdown()
            self._http.server_close()
            self._http.hang_up()
            self._http = None
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def serve(self) -> None:
        """Serve on this thread until the process ends."""
        self.start()
        threading.Event().wait()

    def wait(self, rid: str, seconds: float) -> bool:
        """True if the request was aborted within `seconds`; also returns when the server stops."""
        event = self._aborts.setdefault(rid, threading.Event())
        deadline_s = time.monotonic() + seconds
        while not self.released.is_set():
            remaining_s = deadline_s - time.monotonic()
            if event.wait(max(0.0, min(0.02, remaining_s))):
                return True
            if remaining_s <= 0:
                return False
        return False

    def abort(self, rid: str) -> None:
        """Handle `/abort_request`; unknown ids are accepted."""
        self.seen.aborted.append(rid)
        self._aborts.setdefault(rid, threading.Event()).set()


class _Http(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True
    owner: StandInServer

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._sockets: set[socket.socket] = set()

    def process_request(self, request: Any, client_address: Any) -> None:
        self._sockets.add(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        self._sockets.discard(request)
        super().shutdown_request(request)

    def hang_up(self) -> None:
        """Close every connection."""
        for request in list(self._sockets):
            self.shutdown_request(request)

    def handle_error(self, request: object, client_address: object) -> None:
        """Print nothing: clients may disconnect at any time."""


class _StandInHandler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: _Http

    def log_message(self, *arguments: object) -> None:
        """Print nothing."""

    @property
    def _behaviour(self) -> Behaviour:
        return self.server.owner.behaviour

    def do_GET(self) -> None:
        told = self._behaviour
        if self.path == "/ready":
            self._send(200 if told.ready else 503, b"")
        elif self.path == "/metrics" and told.running is not None:
            self._send(200, metrics_text(told).encode(), "text/plain")
        elif self.path in ("/model_info", "/server_info"):
            if self._may():
                self._json(
                    200, model_info(told) if self.path == "/model_info" else server_info(told)
                )
        else:
            self._json(404, {"detail": "Not Found"})

    def do_POST(self) -> None:
        raw = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if not self._may():
            return
        try:
            body = json.loads(raw)
        except ValueError:
            self._json(
                400,
                {"object": "error", "message": "json_invalid", "type": "Bad Request", "code": 400},
            )
            return
        if self.path == "/abort_request":
            self.server.owner.abort(str(body.get("rid", "")))
            self._send(200, b"")
        elif self.path == "/generate":
            self._generate(body, len(raw))
        else:
            self._json(404, {"detail": "Not Found"})

    def _may(self) -> bool:
        key = self._behaviour.key
        if key and self.headers.get("Authorization") != f"Bearer {key}":
            self._json(401, {"error": "Unauthorized"})
            return False
        return True

    def _generate(self, body: dict[str, Any], size: int) -> None:
        owner, told = self.server.owner, self._behaviour
        rid = str(body.get("rid", "none"))
        owner.seen.generated.append(rid)
        owner.seen.body, owner.seen.body_bytes = body, size
        problem = request_problem(body)
        if problem:
            self._json(400, {"error": {"message": problem}})
            return
        parameters = body["sampling_params"]
        count = int(parameters["max_new_tokens"])
        started_s = time.monotonic()
        if told.fault == "hang":
            owner.wait(rid, 60.0)
            return
        aborted = owner.wait(rid, told.delay_s) if told.delay_s else False
        if owner.released.is_set():  # A killed server answers nobody, not even waiting requests.
            self.close_connection = True
            return
        tokens = expected_tokens(body["input_ids"], base64.b64decode(body["image_data"]), count)
        finish: dict[str, object] = {"type": "length", "length": count}
        if aborted:
            tokens, finish = (
                [],
                {"type": "abort", "message": "Aborted", "status_code": None, "err_type": None},
            )
        reply = generate_reply(
            rid, tokens, finish, len(body["input_ids"]) + 256, time.monotonic() - started_s
        )
        self._reply(told.fault, reply)

    def _reply(self, fault: Fault, reply: dict[str, Any]) -> None:
        tokens = reply["output_ids"]
        if fault == "malformed":
            self._send(200, b"<html>a proxy's page</html>", "text/html")
            return
        if fault == "error":
            self._json(500, {"error": {"message": "Internal Server Error"}})
            return
        if fault == "hang up":
            self.close_connection = True
            return
        if fault == "too long":
            self._send(200, b" " * (5 << 20))
            return
        if fault == "short":
            reply["output_ids"] = tokens[:-1]
        elif fault == "range":
            reply["output_ids"] = [*tokens[:-1], 10**9]
        elif fault == "nan":
            reply["output_ids"] = [*tokens[:-1], 0]
        elif fault == "other":
            reply["meta_info"]["id"] = "another"
        if fault == "trickle":
            self._trickle(json.dumps(reply).encode())
            return
        self._json(200, reply)

    def _trickle(self, raw: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Length", str(len(raw)))
        self.end_headers()
        for index in range(len(raw)):
            self.wfile.write(raw[index : index + 1])
            if self.server.owner.released.wait(0.05):
                return

    def _json(self, status: int, content: Mapping[str, object]) -> None:
        self._send(status, json.dumps(content).encode(), "application/json")

    def _send(self, status: int, content: bytes, kind: str = "text/plain") -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

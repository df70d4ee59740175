"""A model behind an HTTP endpoint, as the locator `http-locator` asks it: it boxes coloured cubes,
is strict about requests, and answers as badly as a test wants.
"""

from __future__ import annotations

import base64
import io
import json
import threading
from collections import deque
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, ClassVar, Self

import numpy as np
from PIL import Image

from rn_testing.fakes.painted_table import PAINT_RGB
from roboneuron import foreign

MOST_BYTES = 32 << 20
_OFF = 60
"""Difference of a channel from the paint of a cube."""
_KEPT = 4
Misbehaviour = Callable[[BaseHTTPRequestHandler], None]
"""Answers a request instead of the server."""


def boxes_in(request: dict[str, Any]) -> dict[str, Any]:
    """A right answer: the box of each coloured cube."""
    detections = []
    for part in request["images"]:
        pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(part["data"], validate=True))))
        height, width = pixels.shape[:2]
        if (width, height) != (part["width"], part["height"]):
            raise ValueError("size")
        if np.shape(part["intrinsics"]) != (3, 3) or np.shape(part["T_base_camera"]) != (4, 4):
            raise ValueError("calibration")
        for colour, paint in PAINT_RGB.items():
            is_painted = np.abs(pixels.astype(np.int16) - paint).max(axis=2) < _OFF
            rows, columns = np.flatnonzero(is_painted.any(1)), np.flatnonzero(is_painted.any(0))
            if not len(rows):
                continue
            edges = [columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]
            found = {"camera": part["camera"], "label": f"{colour} cube", "score": 0.9}
            detections.append({**found, "box": [float(edge) for edge in edges]})
    return {"detections": detections}


class LocatingServer:
    """The server; use it as a context manager.

    Attributes:
        requests: the last decoded requests, the oldest first.
        authorizations: header of each.
        answer: makes an answer of a request; `misbehave` takes precedence.
        misbehave: None to answer.
    """

    def __init__(self) -> None:
        self.requests: deque[dict[str, Any]] = deque(maxlen=_KEPT)
        self.authorizations: deque[str | None] = deque(maxlen=_KEPT)
        self.answer: Callable[[dict[str, Any]], object] = boxes_in
        self.misbehave: Misbehaviour | None = None
        ours = self

        class BoundHandler(LocatingHandler):
            server_of = ours

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), BoundHandler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.02,), daemon=True
        )

    @property
    def url(self) -> str:
        """Its address."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/locate"

    def start(self) -> None:
        """Serve until `stop`, or until the process ends."""
        self._thread.start()

    def stop(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()


class LocatingHandler(BaseHTTPRequestHandler):
    server_of: ClassVar[LocatingServer]

    def do_POST(self) -> None:
        """Answer a request; a wrong one with status 400."""
        ours = self.server_of
        try:
            size = int(self.headers.get("Content-Length", "0"))
            if self.headers.get("Content-Type") != "application/json" or self.path != "/locate":
                raise ValueError("header")
            raw = self.rfile.read(min(size, MOST_BYTES))
            request = foreign.decode_json(raw, "a request", most_bytes=MOST_BYTES)
            if request.keys() != {"labels", "images"}:
                raise ValueError("keys")
            ours.requests.append(request)
            ours.authorizations.append(self.headers.get("Authorization"))
            if ours.misbehave is not None:
                ours.misbehave(self)
                return
            told = ours.answer(request)
            body = told if isinstance(told, bytes) else json.dumps(told).encode()
        except (ValueError, KeyError) as error:
            self.send_error(400, repr(error)[:80].replace("\n", " "))
            return
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""

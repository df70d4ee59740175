"""HTTP requests that the view answers itself: the page, the emergency stop and its state. It also
checks the access of every connection.
"""

from __future__ import annotations

import asyncio
import gzip
import json
import logging
import threading
from collections.abc import Awaitable, Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from rn_standard.http.listener import BACKLOG, BoundedListener
from rn_view.page import stop_bar
from rn_view.page.robot_area import with_robot_area
from rn_view.page.status_strip import with_status_strip
from rn_view.sources.source import Source
from rn_view.teleoperation.stick_panel import with_stick_panel
from rn_view.web import page_requests
from rn_view.web.access import ViewAccess
from rn_view.web.page_requests import OpenPages
from roboneuron import RoboNeuronError

log = logging.getLogger(__name__)
_OPEN_S = 5.0
"""Time limit for the first request of a connection."""
_MOST_BYTES = 1 << 20
"""Maximum size of a message of a page; viser allows 50 MB."""
_PAGE_HEADERS = {
    "X-Frame-Options": "DENY",
    "Cache-Control": "no-store",
    "Content-Type": "text/html; charset=utf-8",
}
_STOPS_AT_ONCE = 8
_patching = threading.Lock()
_silent = logging.getLogger(f"{__name__}.websockets")
_silent.setLevel(logging.CRITICAL)
"""Logger for websockets, which logs a traceback for each client that sends no request."""


class RequestHandler:
    """Answers HTTP requests on viser's event loop.

    Args:
        admission: checks who may connect.
        sources: returns the present sources by robot name.
        who: returns the name of the sender of a request, for the audit.
        visited: called when the page is requested; returns its cookie.
        pages: answers requests of open pages.
    """

    def __init__(
        self,
        admission: ViewAccess,
        sources: Callable[[], Mapping[str, Source]],
        who: Callable[[Request, str], str],
        visited: Callable[[Request], str],
        pages: OpenPages,
    ) -> None:
        self._admission = admission
        self._sources = sources
        self._who = who
        self._visited = visited
        self._open_pages = pages
        self._base = stop_bar.base_page()
        # of its own: the requests of pages may fill the one that they share
        self._stopping = ThreadPoolExecutor(_STOPS_AT_ONCE, thread_name_prefix="page-stop")
        self._page_bytes: dict[tuple[str, ...], tuple[bytes, bytes]] = {}

    async def answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The answer to a request; None for a websocket and for requests that viser answers."""
        if not self._admission.allows(request.headers):
            log.warning(
                "A page of origin %s may not connect to the view.", request.headers.get("Origin")
            )
            return _answer(
                HTTPStatus.FORBIDDEN,
                b"This page may not connect.\n",
                {"Content-Type": "text/plain"},
            )
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return None
        asked = urlsplit(request.path)
        if asked.path in ("/", "/index.html"):
            return self._page(request)
        if asked.path == stop_bar.STATE_PATH:
            latched = {name: source.is_latched() for name, source in self._robots().items()}
            return _json(HTTPStatus.OK, {"latched": latched})
        if asked.path.startswith(page_requests.PATH):
            status, body, kind = await self._open_pages.answer(request.path, request.headers)
            return _answer(status, body, {"Content-Type": kind, "Cache-Control": "no-store"})
        if asked.path == stop_bar.STOP_PATH:
            return await self._stop(
                connection, request, parse_qs(asked.query).get("robot", [""])[0]
            )
        return None

    def _robots(self) -> dict[str, Source]:
        return {name: source for name, source in self._sources().items() if source.playback is None}

    def _page(self, request: Request) -> Response:
        names = tuple(self._sources())
        if names not in self._page_bytes:
            recorded = [
                source.label for source in self._sources().values() if source.playback is not None
            ]
            page = (
                stop_bar.page_without_stop(self._base, recorded[0])
                if recorded
                else stop_bar.page_with_bar(
                    self._base,
                    [name or one.config().namespace for name, one in self._robots().items()],
                    {name: one.release_command for name, one in self._robots().items()},
                )
            )
            page = with_robot_area(page, is_live=not recorded)
            page = page if recorded else with_status_strip(with_stick_panel(page))
            self._page_bytes[names] = page.encode(), gzip.compress(page.encode())
        plain, packed = self._page_bytes[names]
        headers = {**_PAGE_HEADERS, "Set-Cookie": self._visited(request)}
        if "gzip" in request.headers.get("Accept-Encoding", ""):
            return _answer(HTTPStatus.OK, packed, {**headers, "Content-Encoding": "gzip"})
        return _answer(HTTPStatus.OK, plain, headers)

    async def _stop(self, connection: ServerConnection, request: Request, robot: str) -> Response:
        if request.headers.get(stop_bar.HEADER) != stop_bar.HEADER_VALUE:
            return _json(HTTPStatus.FORBIDDEN, {"text": f"The header {stop_bar.HEADER} is missing"})
        robots = self._robots()
        if robot and robot not in robots and len(robots) > 1:
            return _json(HTTPStatus.NOT_FOUND, {"text": f"There is no robot {robot[:80]!r}"})
        chosen = {robot: robots[robot]} if robot in robots else robots
        who = self._who(request, str(connection.remote_address[0]))
        loop = asyncio.get_running_loop()
        pressed = [
            loop.run_in_executor(self._stopping, _press, name, source, who)
            for name, source in chosen.items()
        ]
        done = await asyncio.gather(*pressed)
        is_good = bool(done) and all(good for good, _ in done)
        text = " ".join(text for _, text in done) or "There is no robot to stop"
        return _json(HTTPStatus.OK if is_good else HTTPStatus.INTERNAL_SERVER_ERROR, {"text": text})


@contextmanager
def served_by(
    listener: BoundedListener,
    web: RequestHandler,
    sockets: Mapping[str, Callable[[ServerConnection], Awaitable[None]]],
) -> Iterator[None]:
    """Within the block, viser's websocket server listens on this socket. `web` gets each request
    first; `sockets` serve websockets, by path; viser handles the rest.

    viser has no option to pass a socket, a time-out or a request handler on to websockets.
    """
    original = websockets_server.serve

    def serve(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        async def process(connection: ServerConnection, request: Request) -> Response | None:
            answered = await web.answer(connection, request)
            if answered is not None:
                return answered
            viser_says: Response | None = process_request(connection, request)
            return viser_says

        async def handle(connection: ServerConnection) -> None:
            asked = "" if connection.request is None else connection.request.path
            own = sockets.get(urlsplit(asked).path)
            if own is None:
                await handler(connection)
            else:
                listener.prove(connection.remote_address[:2])
                await own(connection)

        limits = {
            "open_timeout": _OPEN_S,
            "max_size": _MOST_BYTES,
            "logger": _silent,
            "backlog": BACKLOG,
        }
        return original(handle, sock=listener, process_request=process, **{**options, **limits})

    with _patching:
        websockets_server.serve = serve  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            websockets_server.serve = original  # type: ignore[misc]


def _press(name: str, source: Source, who: str) -> tuple[bool, str]:
    before = f"{name}: " if name else ""
    try:
        return True, f"{before}{source.press_stop(who)}"
    except RoboNeuronError as error:
        log.error("%s%s", before, error)
        return False, f"{before}{error}"


def _json(status: HTTPStatus, value: object) -> Response:
    return _answer(status, json.dumps(value).encode(), {"Content-Type": "application/json"})


def _answer(status: HTTPStatus, body: bytes, headers: Mapping[str, str]) -> Response:
    sent = {
        "Content-Length": str(len(body)),
        "Connection": "close",
        "X-Content-Type-Options": "nosniff",
        **headers,
    }
    return Response(status.value, status.phrase, Headers(sent), body)

"""Requests of an open page beside viser's websocket: alarms, rates, maintenance, past tasks.

A page receives a key over its websocket. With this key it proves who its holder is.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection

from rn_view.page.picture_stream import PictureStream
from rn_view.sources.source import PageState, Source
from rn_view.tasks.success_rates import success_rates
from roboneuron import InvalidInputError, NotReadyError, RefusedError, RoboNeuronError
from roboneuron.feature import Holder, Role

PATH = "/page/"
"""GET `state`, `acknowledge?alarm=`, `maintenance?begin=WHY`, `maintenance?end=1`, `tasks`,
`picture?task=&end=`.
"""
PICTURES_PATH = "/page/pictures"
"""Path of the websocket for camera pictures; `?key=` of the page."""
KEY_HEADER = "X-RoboNeuron-Page"
"""Pages of other origins need a permission to send it, and links and images cannot send it."""
UNKNOWN_KEY = 4401
"""Close code of a websocket whose key is not valid."""
_MOST_TEXT = 300
Body = tuple[HTTPStatus, bytes, str]
"""Status, body and content type of an answer."""


@dataclass(frozen=True, slots=True)
class OpenPage:
    """An open page: its holder, its source, the newest state that it shows, and its pictures."""

    holder: Holder
    source: Source
    state: Callable[[], PageState]
    pictures: PictureStream


class OpenPages:
    """The open pages by key; usable from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pages: dict[str, OpenPage] = {}

    def add(self, page: OpenPage) -> str:
        """Register an open page; returns its key."""
        key = secrets.token_urlsafe(24)
        with self._lock:
            self._pages[key] = page
        return key

    def remove(self, key: str) -> None:
        """Remove a page that was closed or shows another robot."""
        with self._lock:
            page = self._pages.pop(key, None)
        if page is not None:
            page.pictures.close()

    async def send_pictures(self, connection: ServerConnection) -> None:
        """Serve a websocket for pictures until it closes."""
        asked = urlsplit("" if connection.request is None else connection.request.path)
        with self._lock:
            page = self._pages.get(parse_qs(asked.query).get("key", [""])[0])
        if page is None:
            await connection.close(UNKNOWN_KEY, "The key of this page is not valid.")
        else:
            await page.pictures.serve(connection)

    async def answer(self, path: str, headers: Mapping[str, str]) -> Body:
        """Answer one request of a page."""
        with self._lock:
            page = self._pages.get(headers.get(KEY_HEADER, ""))
        if page is None:
            text = "The key of this page is not valid; reload the page"
            return _told(HTTPStatus.UNAUTHORIZED, {"text": text})
        asked = urlsplit(path)
        given = {key: values[0] for key, values in parse_qs(asked.query).items()}
        try:
            return await asyncio.to_thread(_answer, page, asked.path.removeprefix(PATH), given)
        except InvalidInputError as error:
            return _told(HTTPStatus.NOT_FOUND, {"text": str(error)})
        except RefusedError as error:
            return _told(HTTPStatus.FORBIDDEN, {"text": str(error)})
        except (RoboNeuronError, OSError) as error:
            return _told(HTTPStatus.SERVICE_UNAVAILABLE, {"text": str(error)})


def _answer(page: OpenPage, what: str, given: Mapping[str, str]) -> Body:
    if what == "state":
        return _told(HTTPStatus.OK, _state(page))
    if what == "acknowledge":
        return _acknowledge(page, given)
    if what == "maintenance":
        return _maintain(page, given)
    if what == "tasks":
        return _tasks(page)
    if what == "picture":
        return _picture(page, given)
    raise InvalidInputError(f"There is no request {what[:40]!r}.", path="path")


def _state(page: OpenPage) -> dict[str, object]:
    """Everything that the strip shows."""
    records, state = page.source.records, page.state()
    told: dict[str, object] = {
        "may_operate": Role.OPERATOR.is_held_by(page.holder.role),
        "may_end": Role.ADMIN.is_held_by(page.holder.role),
        "modules": [
            {
                "kind": row.kind,
                "health": row.health,
                "rate_hz": row.rate_hz,
                "latency_ms": row.latency_ms,
            }
            for row in state.modules
        ],
        "limit": state.limit,
    }
    if records is not None:
        maintenance = records.maintenance
        told["alarms"] = [
            {**asdict(alarm), "is_open": alarm.is_open} for alarm in records.alarms.newest()
        ]
        told["has_tasks"] = records.tasks is not None
        told["maintenance"] = None if maintenance is None else str(maintenance.state or "")
    return told


def _acknowledge(page: OpenPage, given: Mapping[str, str]) -> Body:
    records = page.source.records
    Role.OPERATOR.check(page.holder.who, page.holder.role, "Acknowledging an alarm")
    number = given.get("alarm", "")
    if records is None or not number.isdecimal():
        raise InvalidInputError(f"There is no alarm {number[:20]!r}.", path="alarm")
    alarm = records.alarms.acknowledge(int(number), page.holder.who, page.holder.role)
    return _told(HTTPStatus.OK, asdict(alarm))


def _maintain(page: OpenPage, given: Mapping[str, str]) -> Body:
    records = page.source.records
    if records is None or records.maintenance is None:
        raise NotReadyError("This server has no maintenance mode.")
    who, role = page.holder.who, page.holder.role
    if "begin" in given:
        records.maintenance.begin(who, role, given["begin"][:_MOST_TEXT])
    elif "end" in given:
        records.maintenance.end(who, role)
    return _told(HTTPStatus.OK, {"maintenance": str(records.maintenance.state or "")})


def _tasks(page: OpenPage) -> Body:
    records = page.source.records
    if records is None or records.tasks is None:
        raise NotReadyError("This server has no past tasks.")
    found = records.tasks.newest()
    rates = [asdict(rate) for rate in success_rates(found)]
    return _told(HTTPStatus.OK, {"tasks": [asdict(task) for task in found], "rates": rates})


def _picture(page: OpenPage, given: Mapping[str, str]) -> Body:
    records = page.source.records
    data = None
    if records is not None and records.tasks is not None:
        data = records.tasks.picture(given.get("task", ""), is_end=given.get("end") == "1")
    if data is None:
        raise InvalidInputError("There is no picture of this task.", path="task")
    return HTTPStatus.OK, data, "image/jpeg"


def _told(status: HTTPStatus, value: Mapping[str, Any]) -> Body:
    return status, json.dumps(value).encode(), "application/json"

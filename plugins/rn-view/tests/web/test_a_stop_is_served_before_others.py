"""A stop of the page waits for no other request."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest
from view_fakes import FakeSource, admission
from websockets.datastructures import Headers
from websockets.http11 import Request

from rn_view.options import ViewOptions
from rn_view.page.stop_bar import (
    HEADER,
    HEADER_VALUE,
    STATE_PATH,
    STOP_PATH,
    stop_holder,
)
from rn_view.web.page_requests import OpenPages
from rn_view.web.request_handler import RequestHandler


@pytest.mark.parametrize(
    ("first", "is_stop"),
    [
        (f"GET {STOP_PATH} HTTP/1.1\r\n", True),
        (f"GET {STOP_PATH}?robot=left HTTP/1.1\r\n", True),
        (f"GET {STATE_PATH} HTTP/1.1\r\n", False),
        (f"GET {STOP_PATH}s HTTP/1.1\r\n", False),
        (f"POST {STOP_PATH} HTTP/1.1\r\n", False),
        (f"GET / HTTP/1.1\r\nReferer: {STOP_PATH}\r\n", False),
        ("GET", False),
        ("", False),
    ],
)
def test_a_stop_is_known_by_its_first_line(first: str, is_stop: bool) -> None:
    assert bool(stop_holder(first.encode())) == is_stop


def test_a_stop_is_served_while_requests_of_pages_hold_every_shared_thread() -> None:
    source: Any = FakeSource()
    handler = RequestHandler(
        admission(ViewOptions(enabled=True)),
        lambda: {"": source},
        lambda request, address: address,
        lambda request: "",
        OpenPages(),
    )
    connection: Any = SimpleNamespace(remote_address=("127.0.0.1", 1))
    request = Request(STOP_PATH, Headers({"Host": "127.0.0.1", HEADER: HEADER_VALUE}))
    served = threading.Event()

    async def press() -> int:
        loop = asyncio.get_running_loop()
        loop.set_default_executor(ThreadPoolExecutor(1))
        others = [loop.run_in_executor(None, served.wait) for _ in range(20)]
        try:
            answer = await asyncio.wait_for(handler.answer(connection, request), 20.0)
        finally:
            served.set()
            await asyncio.gather(*others)
        assert answer is not None
        return answer.status_code

    assert asyncio.run(press()) == 200
    assert source.stops == ["127.0.0.1"]

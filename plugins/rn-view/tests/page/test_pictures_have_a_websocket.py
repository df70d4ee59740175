"""Camera pictures reach a page one after the other, and only a page with a key."""

from __future__ import annotations

import io
import json
from collections.abc import Callable

import numpy as np
import pytest
from page_client import PageClient, connect_pictures, next_picture, opened_pictures
from PIL import Image
from view_fakes import FakeSource, picture
from view_page import wait_until
from websockets.exceptions import ConnectionClosed

from rn_view.web.page_requests import UNKNOWN_KEY
from rn_view.web.view_server import ViewServer

pytestmark = pytest.mark.filterwarnings("default:Queued a:UserWarning")
CAMERA = "camera/front/image"


def shade(data: bytes) -> int:
    return int(np.asarray(Image.open(io.BytesIO(data))).mean())


def test_a_page_gets_the_next_picture_after_it_has_drawn_the_last(
    serve: Callable[..., ViewServer], source: FakeSource
) -> None:
    page = PageClient(serve().url)
    with opened_pictures(page) as socket:
        source.send(CAMERA, picture(50))
        first = socket.recv(60.0)
        assert isinstance(first, bytes)
        assert shade(first[1:]) == pytest.approx(50, abs=3)
        source.send(CAMERA, picture(200))
        with pytest.raises(TimeoutError):
            socket.recv(0.5)
        socket.send(str(first[0]))
        assert shade(next_picture(socket)) == pytest.approx(200, abs=3)
    with opened_pictures(page) as socket:  # after a lost connection: the newest one at once
        assert shade(next_picture(socket)) == pytest.approx(200, abs=3)
    page.close()


def test_the_cameras_are_listed_first(serve: Callable[..., ViewServer]) -> None:
    page = PageClient(serve().url)
    wait_until(lambda: bool(page.key))
    with connect_pictures(page.url, page.key) as socket:
        assert json.loads(socket.recv(60.0)) == [
            {"label": "front (primary)", "width": 160, "height": 120}
        ]
    page.close()


@pytest.mark.parametrize("is_closed", [False, True])
def test_without_the_key_of_an_open_page_there_are_no_pictures(
    serve: Callable[..., ViewServer], is_closed: bool
) -> None:
    page = PageClient(serve().url)
    wait_until(lambda: bool(page.key))
    key = page.key if is_closed else "another"
    with opened_pictures(page) as open_before:
        page.close()
        if is_closed:
            with pytest.raises(ConnectionClosed):
                open_before.recv(60.0)
    with connect_pictures(page.url, key) as socket, pytest.raises(ConnectionClosed) as refused:
        socket.recv(60.0)
    assert refused.value.rcvd is not None
    assert refused.value.rcvd.code == UNKNOWN_KEY

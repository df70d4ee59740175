"""The locator `http-locator`: what it sends, what it makes of answers, and what it says when the
endpoint is late, huge, wrong or gone.
"""

from __future__ import annotations

import base64
import io
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from http.server import BaseHTTPRequestHandler
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rn_testing.fakes.locating_server import LocatingServer
from rn_testing.fakes.painted_table import CUBES, EDGE_M, painted_cubes
from roboneuron import (
    CalibratedImage,
    ConfigurationError,
    LocatedObject,
    NotReadyError,
    RoboNeuronError,
    StateError,
)
from roboneuron.errors import ForeignDataError
from roboneuron.sight.http_locator import HttpLocator, HttpLocatorOptions

LIMIT_S = 0.4


@pytest.fixture
def server() -> Iterator[LocatingServer]:
    with LocatingServer() as serving:
        yield serving


def located(server: LocatingServer, images: Any = None, **options: Any) -> list[LocatedObject]:
    locator = HttpLocator(HttpLocatorOptions(url=server.url, **{"format": "png", **options}))
    locator.load()
    return list(locator.locate(painted_cubes() if images is None else images))


def flat(images: Any) -> list[CalibratedImage]:
    """Without depth."""
    return [replace(one, frame=replace(one.frame, depth_m=None)) for one in images]


def off_m(one: LocatedObject) -> float:
    x_m, y_m, _ = CUBES[one.label.split()[0]]
    return float(np.linalg.norm(one.position_m - [x_m, y_m, EDGE_M / 2]))


@pytest.mark.parametrize(
    ("images", "told_m", "is_assumed"),
    [
        (painted_cubes(), 0.004, False),
        (flat(painted_cubes()), 0.025, False),
        (flat(painted_cubes()[:1]), 0.04, True),
        (flat(painted_cubes()[1:]), 0.06, True),
    ],
    ids=["depth", "two views", "above", "side"],
)
def test_boxes_become_places(
    server: LocatingServer, images: Any, told_m: float, is_assumed: bool
) -> None:
    found = located(server, images)
    assert sorted(one.label for one in found) == ["blue cube", "green cube", "red cube"]
    for one in found:
        assert off_m(one) <= one.uncertainty_m <= told_m
        assert one.is_height_assumed is is_assumed
        assert set(one.cameras) == {image.frame.camera for image in images}


def centres(request: dict[str, Any]) -> dict[str, Any]:
    """Points instead of boxes."""
    from rn_testing.fakes.locating_server import boxes_in

    found = boxes_in(request)["detections"]
    for one in found:
        left, upper, right, lower = one.pop("box")
        one["point"] = [(left + right) / 2, (upper + lower) / 2]
    return {"detections": found}


@pytest.mark.parametrize("images", [painted_cubes(), flat(painted_cubes())], ids=["depth", "flat"])
def test_points_become_places(server: LocatingServer, images: Any) -> None:
    server.answer = centres
    found = located(server, images)
    assert len(found) == 3
    assert all(off_m(one) <= one.uncertainty_m for one in found)


def test_the_request_has_pictures_with_their_calibration(server: LocatingServer) -> None:
    images = painted_cubes()
    located(server, labels=["cup", "bowl"])
    (request,) = server.requests
    assert request["labels"] == ["cup", "bowl"]
    assert [part["camera"] for part in request["images"]] == ["above", "side"]
    for part, image in zip(request["images"], images, strict=True):
        sent = np.asarray(Image.open(io.BytesIO(base64.b64decode(part["data"]))))
        np.testing.assert_array_equal(sent, image.frame.image)
        np.testing.assert_allclose(part["intrinsics"], image.view.intrinsics)
        np.testing.assert_allclose(part["T_base_camera"], image.T_base_camera)
    assert "depth" not in str(request.keys())


def test_large_pictures_are_scaled_down_and_boxes_up(server: LocatingServer) -> None:
    found = located(server, most_px=112)
    assert {part["width"] for part in server.requests[0]["images"]} == {112}
    assert server.requests[0]["images"][0]["intrinsics"][0][0] == pytest.approx(110.0)
    assert len(found) == 3
    assert all(off_m(one) <= one.uncertainty_m for one in found)


PLACED = {
    "label": "mug",
    "position_m": [0.5, 0.1, 0.05],
    "size_m": [0.08, 0.08, 0.1],
    "yaw_rad": 6.0,
    "uncertainty_m": 0.01,
    "cameras": ["side", "above"],
}


def test_objects_that_the_model_places_itself_are_taken_over(server: LocatingServer) -> None:
    server.answer = lambda _: {"objects": [PLACED]}
    (one,) = located(server)
    assert one.label == "mug"
    np.testing.assert_array_equal(one.position_m, PLACED["position_m"])
    assert one.yaw_rad == pytest.approx(6.0 - 2 * np.pi)
    assert one.seen_at_ns == 5, "the oldest of its pictures"


def test_words_of_a_model_are_made_printable(server: LocatingServer) -> None:
    hostile = "cup\u202e\x1b[2J" + "x" * 500
    server.answer = lambda _: {
        "detections": [{"camera": "above", "label": hostile, "box": [60, 60, 90, 90]}],
        "objects": [{**PLACED, "label": hostile}],
    }
    for one in located(server):
        assert "\u202e" not in one.label
        assert "\x1b" not in one.label
        assert len(one.label) <= 60


BOX = {"camera": "above", "label": "cup", "score": 0.9, "box": [60.0, 60.0, 90.0, 90.0]}


@pytest.mark.parametrize(
    ("detections", "count"),
    [
        ([], 0),
        ([BOX], 1),
        ([BOX, {**BOX, "box": [61.0, 60.0, 90.0, 90.0], "score": 0.5}], 1),
        ([BOX, {**BOX, "label": "bowl"}], 2),
        ([{**BOX, "score": 0.1}], 0),
        ([{**BOX, "box": [300.0, 300.0, 400.0, 400.0]}], 0),
        ([{**BOX, "box": [-50.0, 60.0, 40.0, 90.0]}], 1),
        ([{"camera": "above", "label": "cup", "point": [-3.0, 5.0]}], 0),
    ],
    ids=["none", "one", "twice", "two labels", "unsure", "outside", "cut", "point outside"],
)
def test_each_detection_is_one_object_or_left_out(
    server: LocatingServer, detections: Any, count: int
) -> None:
    server.answer = lambda _: {"detections": detections}
    assert len(located(server, flat(painted_cubes()))) == count


@pytest.mark.parametrize(
    "answer",
    [
        b"",
        b"<html>",
        b"\xff\xfe",
        b"[]",
        b'{"detections": [' + b"[" * 100 + b"]" * 100 + b"]}",
        b'{"objects": [], "objects": []}',
        b'{"detections": [{"camera": "above", "label": "cup", "box": [NaN, 1, 2, 3]}]}',
        {"detections": [BOX] * 300},
        {"detections": [{**BOX, "camera": "nowhere\x1b"}]},
        {"detections": [{**BOX, "box": [90, 60, 60, 90]}]},
        {"detections": [{**BOX, "box": [1e30, 60, 1e31, 90]}]},
        {"detections": [{**BOX, "point": [1, 2]}]},
        {"detections": [{**BOX, "label": ""}]},
        {"detections": [{**BOX, "label": 7}]},
        {"detections": [{**BOX, "score": 2.0}]},
        {"objects": [{**PLACED, "cameras": []}]},
        {"objects": [{**PLACED, "cameras": ["nowhere"]}]},
        {"objects": [{**PLACED, "size_m": [0.1, 0.1, 0.0]}]},
        {"objects": [{**PLACED, "position_m": [0.1, 0.1]}]},
        {"objects": [{**PLACED, "position_m": [1e6, 0.1, 0.1]}]},
        {"objects": [{**PLACED, "uncertainty_m": -1}]},
    ],
)
def test_a_wrong_answer_is_refused_whole(server: LocatingServer, answer: Any) -> None:
    server.answer = lambda _: answer
    with pytest.raises(ForeignDataError) as refusal:
        located(server)
    assert "\x1b" not in str(refusal.value)
    server.answer = lambda _: {"detections": []}
    assert located(server) == [], "the next call works"


def sleeps(handler: BaseHTTPRequestHandler) -> None:
    handler.connection.recv(1)  # until the client gives up


def drips(body: bool) -> Callable[[BaseHTTPRequestHandler], None]:
    def misbehave(handler: BaseHTTPRequestHandler) -> None:
        start = b"HTTP/1.1 200 OK\r\nContent-Length: 100000\r\n"
        with suppress(OSError):
            handler.connection.sendall(start + (b"\r\n" if body else b"X-A: "))
            handler.connection.settimeout(0.05)
            while True:
                handler.connection.sendall(b"a")
                with suppress(TimeoutError):
                    if not handler.connection.recv(1):
                        return

    return misbehave


def endless(handler: BaseHTTPRequestHandler) -> None:
    with suppress(OSError):
        handler.connection.sendall(b"HTTP/1.1 200 OK\r\n\r\n")
        while True:
            handler.connection.sendall(b" " * 65536)


def sends(data: bytes) -> Callable[[BaseHTTPRequestHandler], None]:
    return lambda handler: handler.connection.sendall(data)


def dies(handler: BaseHTTPRequestHandler) -> None:
    linger = struct.pack("ii", 1, 0)
    handler.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
    handler.connection.close()


@pytest.mark.parametrize(
    ("misbehave", "error", "told"),
    [
        (sleeps, NotReadyError, "within 0.4 s"),
        (drips(body=True), NotReadyError, "within 0.4 s"),
        (drips(body=False), NotReadyError, "within 0.4 s"),
        (endless, ForeignDataError, "larger than"),
        (sends(b"HTTP/1.1 200 OK\r\nContent-Length: 99999999\r\n\r\n"), ForeignDataError, "larger"),
        (sends(b"HTTP/1.1 200 OK\r\nContent-Length: 100\r\n\r\n{}"), NotReadyError, "not answer"),
        (sends(b"HTTP/1.1 200 OK\r\n" + b"X-A: b\r\n" * 500), NotReadyError, "not answer"),
        (sends(b"HTTP/1.1 200 " + b"O" * 99999), NotReadyError, "not answer"),
        (sends(b"SSH-2.0-\x1b[2J\r\n"), NotReadyError, "not answer"),
        (sends(b""), NotReadyError, "not answer"),
        (dies, NotReadyError, "not answer"),
        (sends(b"HTTP/1.1 500 No \x1b[2J\r\n\r\n"), NotReadyError, "answered 500"),
        (sends(b"HTTP/1.1 302 F\r\nLocation: http://127.0.0.1:1/\r\n\r\n"), NotReadyError, "302"),
        (sends(b"HTTP/1.1 204 N\r\n\r\n"), NotReadyError, "answered 204"),
    ],
)
def test_an_endpoint_that_misbehaves_is_named_in_time(
    server: LocatingServer, misbehave: Any, error: type[RoboNeuronError], told: str
) -> None:
    def closes(handler: BaseHTTPRequestHandler) -> None:
        handler.close_connection = True
        misbehave(handler)

    server.misbehave = closes
    began_s = time.monotonic()
    with pytest.raises(error, match=told) as refusal:
        located(server, limit_s=LIMIT_S)
    assert time.monotonic() - began_s < LIMIT_S + 1.0
    assert "\x1b" not in str(refusal.value)
    assert server.url in str(refusal.value)
    server.misbehave = None
    assert len(located(server)) == 3, "the next call works"


def test_an_endpoint_that_nobody_serves_is_named() -> None:
    with LocatingServer() as gone:
        pass
    with pytest.raises(NotReadyError, match="does not answer"):
        located(gone)


@pytest.mark.parametrize(
    "url",
    [
        "",
        "ftp://a/b",
        "http://",
        "a",
        "http://a:99999/",
        "http://a:0/",
        "http://u:p@a/",
        "http://a/ b",
    ],
)
def test_an_address_that_is_none_is_refused_when_it_is_loaded(url: str) -> None:
    with pytest.raises(ConfigurationError, match="url"):
        HttpLocator(HttpLocatorOptions(url=url)).load()


def test_a_token_comes_from_the_environment(
    server: LocatingServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LOCATOR_TOKEN", "secret")
    located(server, token_variable="LOCATOR_TOKEN")
    assert list(server.authorizations) == ["Bearer secret"]
    for bad in ("", "a\nb"):
        monkeypatch.setenv("LOCATOR_TOKEN", bad)
        with pytest.raises(ConfigurationError, match="LOCATOR_TOKEN"):
            located(server, token_variable="LOCATOR_TOKEN")


def test_without_pictures_nobody_is_asked_and_after_close_nothing_works(
    server: LocatingServer,
) -> None:
    locator = HttpLocator(HttpLocatorOptions(url=server.url))
    with pytest.raises(StateError):
        locator.locate(())
    locator.load()
    assert locator.locate(()) == []
    assert not server.requests
    locator.close()
    with pytest.raises(StateError):
        locator.locate(painted_cubes())

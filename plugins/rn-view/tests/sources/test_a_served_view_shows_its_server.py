"""`roboneuron serve --view` as a whole: a real server, its page, and what the stop pressed there
does to modules.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest
from page_client import PageClient, next_picture, opened_pictures
from served_view import Call, attached_view, served_view
from view_page import wait_until

from roboneuron.estop import ESTOP_FILE

pytestmark = [pytest.mark.ros, pytest.mark.timeout(300)]


def module(status: dict[str, Any], kind: str) -> dict[str, Any]:
    return next(found for found in status["modules"] if found["module"] == kind)


def start_and_look(call: Call, page: PageClient) -> None:
    """The page shows each module as it is started, and the call that did it."""
    wait_until(lambda: page.health("robot") == "stopped")
    assert "emergency stop not pressed" in page.text
    for kind in ("robot", "perception"):
        call(f"start_{kind}")
        wait_until(lambda kind=kind: page.health(kind) == "ok")  # type: ignore[misc]
        wait_until(lambda kind=kind: f"start_{kind}(): done" in page.text)  # type: ignore[misc]
    with opened_pictures(page) as socket:
        for _ in range(3):
            assert next_picture(socket)


def test_the_page_shows_the_state_and_its_stop_reaches_the_modules(tmp_path: Path) -> None:
    with served_view(tmp_path) as (call, url):
        with urlopen(url, timeout=60) as answer:
            assert answer.status == 200
            assert b"<html" in answer.read()
        page = PageClient(url)
        start_and_look(call, page)
        assert not call("get_status")["emergency_stop"]

        page.press_stop()
        wait_until(lambda: "EMERGENCY STOP LATCHED" in page.text)
        wait_until(lambda: bool(module(call("get_status"), "robot")["emergency_stop"]))
        status = call("get_status")
        assert status["emergency_stop"]
        assert "pressed in the live view" in status["emergency_stop_cause"]
        assert (tmp_path / "state" / ESTOP_FILE).exists()
        wait_until(lambda: "latched" in page.text)  # the audit's line

        page.close()
        again = PageClient(url)
        # a page that comes later sees it, too
        wait_until(lambda: "EMERGENCY STOP LATCHED" in again.text)
        again.close()


@pytest.mark.slow
def test_a_view_beside_the_server_shows_it_and_stops_it(tmp_path: Path) -> None:
    with served_view(tmp_path) as (call, _):
        call("start_robot")
        with attached_view(tmp_path) as url:
            page = PageClient(url)
            wait_until(lambda: page.health("robot") == "ok")
            page.press_stop()
            wait_until(lambda: "EMERGENCY STOP LATCHED" in page.text)
            wait_until(lambda: bool(module(call("get_status"), "robot")["emergency_stop"]))
            assert "pressed in the attached view" in call("get_status")["emergency_stop_cause"]
            page.close()


@pytest.mark.slow
@pytest.mark.filterwarnings("default:Queued a:UserWarning")
def test_a_person_sees_the_server_and_stops_it_in_a_browser(tmp_path: Path, look: Any) -> None:
    with served_view(tmp_path) as (call, url):
        page = look(url)
        call("start_robot")
        page.get_by_text("start_robot(): done").first.wait_for()
        page.get_by_role("button", name="EMERGENCY STOP").click()
        page.get_by_text("EMERGENCY STOP LATCHED").wait_for()
        wait_until(lambda: bool(module(call("get_status"), "robot")["emergency_stop"]))
        page.context.close()

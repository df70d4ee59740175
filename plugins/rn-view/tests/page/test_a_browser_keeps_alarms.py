"""Alarms, maintenance and past tasks in a real browser: seen at every size, by keyboard, after a
reload.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from view_fakes import FakeSource, MaintenanceSwitch
from view_page import wait_until

from rn_standard.tasks.history import TaskHistory
from rn_view.diagnostics.alarms import AlarmBook
from rn_view.sources.records import RobotRecords
from rn_view.tasks.past_tasks import PastTasks
from rn_view.web.view_server import ViewServer
from roboneuron.feature import AuditLog

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.filterwarnings("default:Queued a:UserWarning"),
]
SIZES = {"desk": (1440, 900), "tablet": (820, 1180), "phone": (390, 844)}
FREE = """one => {
  const box = one.getBoundingClientRect();
  return box.x >= 0 && box.right <= innerWidth && box.bottom <= innerHeight && [0.1, 0.5, 0.9].every(share =>
    one.contains(document.elementFromPoint(box.x + share * box.width, box.y + box.height / 2)));
}"""  # noqa: E501
"""Whether an element is within the page and nothing covers it."""


@pytest.fixture
def book(source: FakeSource, tmp_path: Path) -> AlarmBook:
    """The alarms of the page's robot."""
    book = AlarmBook(tmp_path, AuditLog.in_directory(tmp_path))
    source.records = RobotRecords(
        alarms=book, maintenance=MaintenanceSwitch(), tasks=PastTasks(tmp_path)
    )
    return book


def test_an_alarm_is_seen_at_every_size_until_somebody_acknowledges_it_by_keyboard(
    serve: Callable[..., ViewServer], look: Callable[..., Any], book: AlarmBook, tmp_path: Path
) -> None:
    page = look(serve().url)
    opener = page.locator("#rn-alarms-open")
    page.get_by_role("button", name="No alarms").wait_for()
    cause = "The TCP would enter <b>'edge'</b>."
    book.add("control", "hold: zone", cause, "Give it anew.")
    page.get_by_role("button", name="1 alarm: control, hold: zone").wait_for()
    assert (
        page.locator("#rn-alert[role=alert]").inner_text() == f"Alarm: control, hold: zone. {cause}"
    )
    for size in SIZES.values():
        page.set_viewport_size({"width": size[0], "height": size[1]})
        assert opener.evaluate(FREE)
        stop = page.get_by_role("button", name="EMERGENCY STOP")
        assert stop.evaluate(FREE)
        assert stop.bounding_box()["height"] > opener.bounding_box()["height"]
    page.reload()
    page.get_by_role("button", name="1 alarm: control, hold: zone").press("Enter")
    assert page.evaluate("document.activeElement.id") == "rn-records-title"
    page.get_by_text("What to do: Give it anew.").wait_for()
    page.keyboard.press("Tab")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.get_by_text("Acknowledged by local HTTP client view").wait_for()
    page.get_by_role("button", name="No alarms").wait_for()
    page.keyboard.press("Escape")
    assert opener.evaluate("one => one === document.activeElement")
    lines = (tmp_path / "audit.jsonl").read_text().splitlines()
    assert [json.loads(line)["tool"] for line in lines] == ["acknowledge_alarm"]


def test_a_person_takes_the_robot_out_of_service_and_puts_it_back(
    serve: Callable[..., ViewServer], look: Callable[..., Any], book: AlarmBook, source: FakeSource
) -> None:
    page = look(serve().url)
    page.get_by_role("button", name="Maintenance").click()
    page.get_by_role("textbox", name="Reason").fill("new <cable>")
    page.keyboard.press("Enter")
    page.get_by_role("button", name="Out of service").wait_for()
    page.get_by_text("took the robot out of service: new <cable>").wait_for()
    page.get_by_role("button", name="Put the robot back in service").click()
    page.get_by_text("The emergency stop is still latched").wait_for()
    page.get_by_role("button", name="Maintenance", exact=True).wait_for()


def test_past_tasks_are_listed_with_their_pictures_and_rates(
    serve: Callable[..., ViewServer], look: Callable[..., Any], book: AlarmBook, tmp_path: Path
) -> None:
    from PIL import Image

    history, tasks = TaskHistory(tmp_path), PastTasks(tmp_path)
    for outcome in ("succeeded", "failed"):
        history.note("lift <it>", outcome, "a reason", took_s=4.2, model={"backend": "cubes"})
    tasks.folder.mkdir()
    number = tasks.newest()[0].number
    Image.new("RGB", (32, 24), (200, 0, 0)).save(tasks.folder / f"{number}-end.jpg")
    page = look(serve().url)
    page.get_by_role("button", name="Past tasks").click()
    page.get_by_text("failed: lift <it>").wait_for()
    assert page.get_by_role("row").nth(1).inner_text().split("\t")[:3] == [
        "backend cubes",
        "lift <it>",
        "1 of 2",
    ]
    shown = page.get_by_role("img", name="Camera at the end")
    wait_until(lambda: shown.evaluate("one => one.naturalWidth") == 32)
    assert page.get_by_text("no picture of the start").count() == 2


def test_rates_and_the_limit_that_acts_are_seen_at_a_glance(
    serve: Callable[..., ViewServer],
    look: Callable[..., Any],
    source: FakeSource,
) -> None:
    page = look(serve().url)
    glance = page.locator("#rn-glance")
    page.get_by_text("robot 100 Hz").wait_for()
    assert "policy failing!" in glance.inner_text()
    assert page.locator("#rn-alarms-open").is_hidden(), "only a server keeps alarms"
    reason = "j1 would move at 9 per second, allowed is 2."
    counts = 1

    def acts() -> bool:
        nonlocal counts
        counts += 1
        source.limited = (reason, {"velocity": counts})
        return bool(glance.inner_text() == f"Limit: {reason}")

    wait_until(acts)
    page.get_by_text("robot 100 Hz").wait_for()

"""The page at three sizes while it loads, is idle, leads, has alarms, and after a stop: nothing is
cut or covered, and whoever leads sees the arm and every camera.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from view_fakes import FakeSource, MaintenanceSwitch, joints, picture, profile
from view_page import wait_until

from rn_view.diagnostics.alarms import AlarmBook
from rn_view.page import robot_area
from rn_view.sources.records import RobotRecords
from rn_view.web.view_server import ViewServer
from roboneuron.feature import AuditLog

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.filterwarnings("default:Queued a:UserWarning"),
]
SIZES = {"phone": (390, 844), "tablet": (820, 1180), "desk": (1440, 900)}
FAULTS = """() => {
  const found = [], root = document.documentElement;
  if (root.scrollWidth > innerWidth || document.body.scrollHeight > innerHeight) found.push("the page scrolls");
  const name = one => one.id || one.innerText || one.tagName;
  const free = one => {
    const box = one.getBoundingClientRect();
    return box.left >= 0 && box.top >= 0 && box.right <= innerWidth && box.bottom <= innerHeight && [.1, .5, .9].every(x =>
      [.1, .5, .9].every(y => one.contains(document.elementFromPoint(box.x + x * box.width, box.y + y * box.height))));
  };
  const stop = document.getElementById("rn-stop").getBoundingClientRect();
  if (!free(document.getElementById("rn-stop")) || stop.height < 60 || stop.width < innerWidth / 2) found.push("the stop is not free");
  for (const one of document.querySelectorAll("#rn-bar button, #rn-strip button, #rn-records button, #rn-lead :is(button, select, input)")) {
    const box = one.getBoundingClientRect();
    if (!one.checkVisibility() || !box.width) continue;
    if (box.height < 43.5 || box.width < 43.5) found.push("small: " + name(one));
    if (!one.closest("#rn-records") && !free(one)) found.push("covered: " + name(one));
  }
  for (const one of document.querySelectorAll("#rn-state, #rn-state code, #rn-strip button, #rn-glance, #rn-lead button, #rn-lead-state, #rn-wait, #rn-cameras figcaption")) {
    if (one.checkVisibility() && (one.scrollWidth > one.clientWidth + 1 || one.scrollHeight > one.clientHeight + 1) && getComputedStyle(one).display !== "inline")
      found.push("cut: " + name(one));
  }
  return found;
}"""  # noqa: E501
LED = """() => {
  const found = [], seen = (one, x, y) => one.contains(document.elementFromPoint(x, y));
  for (const one of document.querySelectorAll("#rn-cameras figure, .rn-stick")) {
    const box = one.getBoundingClientRect();
    if (box.width < 100 || box.height < 100) found.push("small: " + one.innerText);
    if (!seen(one, box.x + box.width / 2, box.y + box.height / 2) || box.bottom > innerHeight) found.push("covered: " + one.innerText);
  }
  const box = document.getElementById("rn-scene").getBoundingClientRect(), root = document.getElementById("root");
  const panels = ".mantine-Paper-root, .mantine-ScrollArea-root, .mantine-Tabs-root";
  let free = 0;
  for (let i = 1; i < 10; i++) {
    const hit = document.elementFromPoint(box.x + i * box.width / 10, box.y + box.height / 2);
    free += root.contains(hit) && !hit.closest(panels);
  }
  if (box.height < 150 || free < 9) found.push("the arm is hidden: " + box.height + " px, " + free);
  if (document.getElementById("rn-cameras").getBoundingClientRect().top > document.getElementById("rn-lead").getBoundingClientRect().top) found.push("sticks above");
  return found;
}"""  # noqa: E501


@pytest.mark.parametrize("size", SIZES)
def test_nothing_is_cut_or_covered_in_any_state(
    serve: Callable[..., ViewServer], browser: Any, source: FakeSource, tmp_path: Path, size: str
) -> None:
    front = profile().cameras[0]
    cameras = (front, replace(front, name="wrist", role="wrist", frame_id="wrist"))
    shown, may_load = replace(profile(), cameras=cameras), threading.Event()
    source.profile = lambda: may_load.wait(120) and shown  # type: ignore[assignment,method-assign]
    book = AlarmBook(tmp_path, AuditLog.in_directory(tmp_path))
    source.records = RobotRecords(alarms=book, maintenance=MaintenanceSwitch())
    url = serve().url
    width, height = SIZES[size]
    context = browser.new_context(viewport={"width": width, "height": height})
    page = context.new_page()
    page.set_default_timeout(120_000)
    try:
        page.goto(url)
        page.get_by_text("Waiting for the robot ...").wait_for()
        assert page.evaluate(FAULTS) == [], "loading"
        may_load.set()
        page.locator("#rn-lead-open").wait_for()

        def shows_pictures() -> bool:
            source.send("joint_states", joints(turn=0.3, lift=0.2))
            for camera in cameras:
                source.send(f"camera/{camera.name}/image", picture(90))
            return bool(page.locator("#rn-cameras img[src]").count() == len(cameras))

        wait_until(shows_pictures)
        page.get_by_text("robot 100 Hz").wait_for()
        assert page.evaluate(FAULTS) == [], "idle"
        assert page.locator("#webgl-software-rendering").bounding_box()["height"] < 30

        page.locator("#rn-lead-open").click()
        page.locator("#rn-lead-go:enabled").click()
        page.get_by_text("You lead.").wait_for()
        wait_until(lambda: page.evaluate(LED) == [])
        assert page.get_by_text("Give the instruction").filter(visible=True).count() == 0
        assert page.evaluate(FAULTS) == [], "leading"
        page.locator("#rn-lead-close").click()
        page.locator("#rn-lead-open").wait_for()

        book.add("control", "hold: zone", "The TCP would enter 'edge'.", "Give it anew.")
        page.locator("#rn-alarms-open.bad").click()
        page.get_by_text("What to do: Give it anew.").wait_for()
        assert page.evaluate(FAULTS) == [], "alarm"
        page.locator("#rn-records-close").click()

        page.locator("#rn-stop").click()
        page.locator("#rn-state code").wait_for()
        assert page.locator("#rn-state code").inner_text() == source.release_command
        assert socket.gethostname() in page.locator("#rn-state").inner_text()
        assert page.evaluate(FAULTS) == [], "stopped"
    finally:
        may_load.set()
        context.close()


def test_a_page_that_stays_empty_reloads_itself(
    serve: Callable[..., ViewServer],
    browser: Any,
    source: FakeSource,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(robot_area, "RELOAD_S", 3.0)
    may_load = threading.Event()
    source.profile = lambda: may_load.wait(120) and profile()  # type: ignore[assignment,method-assign]
    context = browser.new_context(viewport={"width": 700, "height": 500})
    page = context.new_page()
    page.set_default_timeout(120_000)
    try:
        page.goto(f"{serve().url}/")
        page.get_by_text("Waiting for the robot ...").wait_for()
        with page.expect_event("load"):
            pass
        may_load.set()
        page.locator("#rn-lead-open").wait_for()
        page.locator("#rn-wait:not([hidden]):not(.note)").wait_for(state="detached")
    finally:
        may_load.set()
        context.close()

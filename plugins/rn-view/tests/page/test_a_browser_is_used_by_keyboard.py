"""By day and by night: contrast of every text of ours, labels, a visible focus, and no trap for the
keyboard.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from view_fakes import FakeSource, MaintenanceSwitch
from view_page import LEAST_CONTRAST, TEXT_CONTRAST, UNLABELLED

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
FOCUS = """() => {
  const one = document.activeElement, style = getComputedStyle(one);
  return [one.id, !!one.closest('#rn-bar, #rn-strip, #rn-records, #rn-lead'),
    style.outlineStyle !== 'none' && parseFloat(style.outlineWidth) >= 2];
}"""
"""Which element has the focus, whether it is one of ours, and whether one sees it."""
_MOST_TABS = 150


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_everything_can_be_read_and_reached(
    serve: Callable[..., ViewServer],
    look: Callable[..., Any],
    source: FakeSource,
    tmp_path: Path,
    scheme: str,
) -> None:
    book = AlarmBook(tmp_path, AuditLog.in_directory(tmp_path))
    for is_warning in (False, True):
        book.add("control", f"limit {is_warning}", "a cause", "do it", is_warning=is_warning)
    book.acknowledge(book.add("robot", "exited", "gone", "start it").number, "ann", "operator")
    history, switch = TaskHistory(tmp_path), MaintenanceSwitch()
    for outcome in ("succeeded", "failed", "stopped"):
        history.note("lift", outcome, "why", took_s=1.0)
    source.records = RobotRecords(alarms=book, maintenance=switch, tasks=PastTasks(tmp_path))
    page = look(serve().url)
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": 820, "height": 1180})
    for name in ("alarms", "tasks", "service"):
        page.locator(f"#rn-{name}-open").click()
        page.locator("#rn-records-body :is(p, li, form)").first.wait_for()
        assert page.evaluate(TEXT_CONTRAST, "rn-records") >= LEAST_CONTRAST
        assert page.evaluate(UNLABELLED) == []
    switch.begin("ann", "admin", "cable")
    page.locator("#rn-service-open.out").wait_for()
    page.get_by_role("button", name="Put the robot back in service").wait_for()
    for part in ("rn-bar", "rn-strip", "rn-records"):
        assert page.evaluate(TEXT_CONTRAST, part) >= LEAST_CONTRAST
    assert page.locator("#rn-state").get_attribute("aria-live") == "assertive"

    page.locator("#rn-lead-open").wait_for()
    page.locator("#rn-stop").focus()
    seen: list[str] = []
    for _ in range(_MOST_TABS):
        page.keyboard.press("Tab")
        where, is_ours, is_visible = page.evaluate(FOCUS)
        assert is_visible or not is_ours, where
        seen.append(where)
        if where in ("", "rn-stop") and "rn-lead-open" in seen:
            break
    assert {"rn-alarms-open", "rn-tasks-open", "rn-service-open", "rn-records-close"} <= set(seen)
    assert "rn-lead-open" in seen, "the end of the page is reached: nothing keeps the focus"

"""What an open page may ask beside its websocket, with the rights of whoever looks."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from view_fakes import FakeSource

from rn_standard.tasks.history import TaskHistory
from rn_view.diagnostics.alarms import AlarmBook
from rn_view.page.picture_stream import PictureStream
from rn_view.sources.records import RobotRecords
from rn_view.sources.source import PageState
from rn_view.tasks.past_tasks import PastTasks
from rn_view.tasks.success_rates import success_rates
from rn_view.web.page_requests import KEY_HEADER, OpenPage, OpenPages
from roboneuron import RefusedError
from roboneuron.feature import AuditLog, Holder


class Switch:
    """A maintenance mode without a robot."""

    def __init__(self) -> None:
        self.state: str | None = None

    def begin(self, who: str, role: str, reason: str) -> str:
        self.state = f"{who}: {reason}"
        return self.state

    def end(self, who: str, role: str) -> None:
        if role != "admin":
            raise RefusedError("Only an admin.", rule="role")
        self.state = None


class Asked:
    """Seats with one page of each role."""

    def __init__(self, folder: Path) -> None:
        self.source = FakeSource()
        self.audit = AuditLog.in_directory(folder)
        self.book = AlarmBook(folder, self.audit)
        self.source.records = RobotRecords(
            alarms=self.book, maintenance=Switch(), tasks=PastTasks(folder)
        )
        self.pages = OpenPages()
        self.keys = {
            role: self.pages.add(
                OpenPage(
                    Holder(who=f"the {role}", role=role),
                    self.source,
                    self.source.snapshot,
                    PictureStream(()),
                )
            )
            for role in ("viewer", "operator", "admin")
        }

    def ask(self, role: str, path: str) -> tuple[int, Any]:
        headers = {KEY_HEADER: self.keys.get(role, role)}
        status, body, kind = asyncio.run(self.pages.answer(f"/page/{path}", headers))
        return int(status), json.loads(body) if kind == "application/json" else body


@pytest.fixture
def asked(tmp_path: Path) -> Asked:
    return Asked(tmp_path)


def test_a_page_that_is_not_known_or_gone_learns_nothing(asked: Asked) -> None:
    assert asked.ask("somebody", "state")[0] == 401
    asked.pages.remove(asked.keys["admin"])
    assert asked.ask("admin", "state")[0] == 401


def test_everybody_sees_alarms_and_an_operator_acknowledges_them(asked: Asked) -> None:
    number = asked.book.add("robot", "exited", "<b>gone</b>", "start it").number
    status, told = asked.ask("viewer", "state")
    assert (status, told["may_operate"], told["alarms"][0]["is_open"]) == (200, False, True)
    status, told = asked.ask("viewer", f"acknowledge?alarm={number}")
    assert status == 403
    assert "operator" in told["text"]
    assert asked.ask("operator", f"acknowledge?alarm={number}")[0] == 200
    assert asked.book.newest()[0].acknowledged_by == "the operator"


@pytest.mark.parametrize(
    "path",
    [
        "acknowledge?alarm=7",
        "acknowledge?alarm=-1",
        "acknowledge",
        "nothing",
        "picture?task=../../x&end=1",
        "picture?task=1-1",
    ],
)
def test_what_is_not_there_is_refused(asked: Asked, path: str) -> None:
    assert asked.ask("admin", path)[0] == 404


def test_an_operator_begins_maintenance_and_an_admin_ends_it(asked: Asked) -> None:
    assert asked.ask("operator", "maintenance?begin=new%20cable")[1] == {
        "maintenance": "the operator: new cable"
    }
    assert asked.ask("viewer", "state")[1]["maintenance"] == "the operator: new cable"
    assert asked.ask("operator", "maintenance?end=1")[0] == 403
    assert asked.ask("admin", "maintenance?end=1")[1] == {"maintenance": ""}


def test_a_source_without_a_server_has_rates_only(asked: Asked) -> None:
    asked.source.records = None
    status, told = asked.ask("admin", "state")
    assert status == 200
    assert "alarms" not in told
    assert [one["kind"] for one in told["modules"]] == ["robot", "inference"]
    assert asked.ask("admin", "maintenance?begin=x")[0] == 503
    assert asked.ask("admin", "tasks")[0] == 503


def test_tasks_come_with_rates_by_model_and_words(asked: Asked, tmp_path: Path) -> None:
    history = TaskHistory(tmp_path)
    for outcome in ("succeeded", "failed", "succeeded", "stopped", "taken_over"):
        model = {"backend": "cubes"}
        history.note("Pick  up", outcome, "", took_s=4.0, model=model)
    history.note("pick up", "timed_out", "", took_s=60.0, model={"backend": "oft"})
    status, told = asked.ask("viewer", "tasks")
    assert status == 200
    assert [task["outcome"] for task in told["tasks"]][:2] == ["timed_out", "taken_over"]
    cubes, oft = told["rates"]
    assert (cubes["model"], cubes["instruction"]) == ("backend cubes", "pick up")
    assert (cubes["succeeded"], cubes["judged"], cubes["median_s"]) == (2, 3, 4.0)
    assert (oft["succeeded"], oft["judged"], oft["median_s"]) == (0, 1, None)
    assert len({task["number"] for task in told["tasks"]}) == 6


def test_the_interval_of_a_rate_is_wilsons(asked: Asked, tmp_path: Path) -> None:
    """Source: E. B. Wilson 1927; 9 of 10 has the 95 % interval 59.6 % to 98.2 %."""
    history = TaskHistory(tmp_path)
    for number in range(10):
        history.note("x", "succeeded" if number else "failed", "")
    (rate,) = success_rates(PastTasks(tmp_path).newest())
    assert (round(rate.low, 3), round(rate.high, 3)) == (0.596, 0.982)


def test_a_page_of_an_unreadable_history_says_so(asked: Asked, tmp_path: Path) -> None:
    (tmp_path / "tasks.jsonl").mkdir()
    assert asked.ask("viewer", "tasks")[0] == 503


def test_a_state_names_the_limit_that_acts(asked: Asked) -> None:
    state = PageState(limit="j1 would move at 9.", limits=("velocity",))
    key = asked.pages.add(
        OpenPage(Holder(who="x", role="viewer"), asked.source, lambda: state, PictureStream(()))
    )
    asked.keys["x"] = key
    assert asked.ask("x", "state")[1]["limit"] == "j1 would move at 9."

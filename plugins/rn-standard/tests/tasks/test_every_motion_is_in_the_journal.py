"""get_journal: what clients' calls have moved or changed, bounded, paged, of this robot."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from mcp import Client, types
from pydantic import Field

from rn_standard.tasks.history import TaskHistory
from rn_standard.tasks.plugin import FEATURE
from rn_testing.fakes import fake_registry
from roboneuron import (
    Arguments,
    CallContext,
    Feature,
    RefusedError,
    Result,
    StateError,
    Tool,
)
from roboneuron.config import parse_config
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.selection.plugin import FEATURE as SELECTION
from roboneuron.server.app import Application
from roboneuron.tools.arm.landing import MissedError
from roboneuron.tools.arm.plugin import FEATURE as ARM
from roboneuron.tools.arm.plugin import STOP_MOTION


class Turn(Arguments):
    """Arguments of a motion."""

    angle_rad: float = 0.0


async def turned(arguments: Turn, context: CallContext) -> Result:
    if arguments.angle_rad > 3:
        raise RefusedError("Too far.", rule="a test")
    if arguments.angle_rad < 0:
        raise MissedError("red cube", np.zeros(3), np.array([0.1, 0.2, 0.3]))
    return Result()


def motion(name: str = "turn", **more: Any) -> Tool[Turn]:
    return Tool(
        name=name,
        title=name,
        description=name,
        arguments=Turn,
        result=Result,
        handler=turned,
        open_world=True,
        **{"simulated_by": frozenset({"limits"})} | more,
    )


class Change(Arguments):
    """Arguments of a change that moves nothing."""

    value: float = 0.0


class Changed(Result):
    """Answer of a change, with fields of all of them."""

    id: str = "run-7"
    started_with: dict[str, str]
    started: list[dict[str, Any]] = Field(default_factory=list)


async def changed(arguments: Change, context: CallContext) -> Changed:
    if arguments.value < 0:
        raise RefusedError("Not below.", rule="a test")
    return Changed(started_with={"source": "fake"})


def change(name: str) -> Tool[Change]:
    return Tool(
        name=name,
        title=name,
        description=name,
        arguments=Change,
        result=Changed,
        handler=changed,
    )


@pytest.fixture
def application(tmp_path: Path) -> Iterator[Application]:
    registry = fake_registry(DIRECT_PATH, SELECTION, FEATURE, ARM, STOP_MOTION)
    made = Application(
        parse_config('[robot]\nname = "gantry"\n', registry=registry),
        plugins=lambda: registry,
        directory=tmp_path,
        command=lambda python: pytest.fail("nothing may be spawned"),
    )
    made.tools.add_all([motion(), motion("lift"), motion("look_at", simulated_by=frozenset())])
    made.tools.add_all([change(name) for name in ("tighten_limits", "start_recording")])
    made.tools.add_all([change("switch_perception")])
    yield made
    made.close()


@pytest.fixture
def call(application: Application) -> Callable[..., types.CallToolResult]:
    def call(name: str, /, **arguments: Any) -> types.CallToolResult:
        async def ask() -> types.CallToolResult:
            async with Client(application.server) as client:
                return await client.call_tool(name, arguments)

        return anyio.run(ask)

    return call


def journal(call: Callable[..., types.CallToolResult], **arguments: Any) -> dict[str, Any]:
    answer = call("get_journal", **arguments)
    assert not answer.is_error, answer.content
    return dict(answer.structured_content or {})


def test_a_motion_is_told_with_words_tool_outcome_and_duration(
    call: Callable[..., types.CallToolResult],
) -> None:
    call("turn", angle_rad=0.5)
    (entry,) = journal(call)["entries"]
    assert (entry["tool"], entry["kind"], entry["outcome"]) == ("turn", "tool", "done")
    assert "0.5" in entry["instruction"]
    assert datetime.fromisoformat(entry["at"]) <= datetime.now(UTC)


def test_a_refused_motion_is_told_with_its_reason(
    call: Callable[..., types.CallToolResult],
) -> None:
    call("turn", angle_rad=4.0)
    (entry,) = journal(call)["entries"]
    assert (entry["outcome"], entry["reason"]) == ("refused", "Too far.")


class Meter(Feature[None]):
    """A feature that has measured speeds, by quarters of a second."""

    def __init__(self) -> None:
        super().__init__(None)
        self.speeds: list[tuple[float, float]] = []

    def fastest_m_s(self, since_s: float) -> float | None:
        return max((speed for at_s, speed in self.speeds if at_s > since_s - 0.25), default=None)


@pytest.mark.parametrize("moves", ["before", "after"])
def test_a_refused_call_carries_no_speed_of_other_motions(
    application: Application, call: Callable[..., types.CallToolResult], moves: str
) -> None:
    meter = Meter()
    application.host.features.loaded["meter"] = meter
    if moves == "before":
        meter.speeds.append((time.monotonic() - 0.1, 0.2))
    call("turn", angle_rad=4.0)
    if moves == "after":
        meter.speeds.append((time.monotonic(), 0.2))
    call("lift")
    (refused,) = (one for one in journal(call)["entries"] if one["tool"] == "turn")
    assert "max_tcp_speed_m_s" not in refused


def test_a_miss_is_an_outcome_of_its_own_with_the_place(
    call: Callable[..., types.CallToolResult],
) -> None:
    assert call("turn", angle_rad=-1.0).is_error
    (entry,) = journal(call)["entries"]
    assert entry["outcome"] == "missed"
    assert "[0.1, 0.2, 0.3]" in entry["reason"]


def test_what_moves_nothing_is_not_told(call: Callable[..., types.CallToolResult]) -> None:
    call("look_at")
    call("turn", simulate=True)
    call("turn", angle_rad="far")
    assert journal(call)["entries"] == []


def test_short_calls_of_one_tool_are_one_entry(
    call: Callable[..., types.CallToolResult],
) -> None:
    for _ in range(5):
        call("turn", angle_rad=0.1)
    call("lift")
    call("stop_motion")
    entries = journal(call)["entries"]
    assert [(one["tool"], one.get("calls", 1)) for one in entries] == [
        ("stop_motion", 1),
        ("lift", 1),
        ("turn", 5),
    ]
    assert [one["kind"] for one in entries] == ["stop", "tool", "tool"]
    assert [one["tool"] for one in journal(call, kind="stop")["entries"]] == ["stop_motion"]


@pytest.mark.parametrize(
    ("tool", "kind"),
    [
        ("tighten_limits", "limits"),
        ("start_recording", "recording"),
        ("switch_perception", "switch"),
    ],
)
def test_changes_are_told_one_by_one_also_refused_ones_without_a_speed(
    application: Application,
    call: Callable[..., types.CallToolResult],
    tool: str,
    kind: str,
) -> None:
    meter = Meter()
    meter.speeds.append((time.monotonic() + 60.0, 0.2))
    application.host.features.loaded["meter"] = meter
    call("turn")
    for value in (0.1, 0.2, -1.0):
        call(tool, value=value)
    entries = journal(call, kind=kind)["entries"]
    assert [one["outcome"] for one in entries] == ["refused", "done", "done"]
    assert [one["tool"] for one in entries] == [tool] * 3
    told = {"value": 0.1, "id": "run-7", "started_with": {"source": "fake"}}
    assert json.loads(entries[-1]["instruction"]) == told
    assert all("max_tcp_speed_m_s" not in one for one in entries)
    assert {one["kind"] for one in journal(call)["entries"]} == {kind, "tool"}


def test_a_start_of_several_modules_tells_its_policy_first(
    application: Application, call: Callable[..., types.CallToolResult]
) -> None:
    async def started(arguments: Change, context: CallContext) -> Changed:
        modules = [
            {"module": "robot", "started_with": {"driver": "simulated"}},
            {"module": "inference", "started_with": {"backend": "servo"}},
        ]
        return Changed(id="", started_with={}, started=modules)

    application.tools.add_all([replace(change("switch_control"), handler=started)])
    call("switch_control")
    (entry,) = journal(call, kind="switch")["entries"]
    words = json.loads(entry["instruction"])
    assert next(iter(words.items())) == ("inference", {"backend": "servo"})
    assert words["robot"] == {"driver": "simulated"}


def test_a_change_without_a_call_is_told_with_who_made_it(
    application: Application, call: Callable[..., types.CallToolResult]
) -> None:
    application.host.events.uncalled.tell("loosen_limits", "a person in a terminal", {"by": "yes"})
    (entry,) = journal(call, kind="limits")["entries"]
    assert (entry["tool"], entry["who"]) == ("loosen_limits", "a person in a terminal")
    assert json.loads(entry["instruction"]) == {"by": "yes"}


def test_the_journal_is_read_by_pages_and_from_a_time_on(
    call: Callable[..., types.CallToolResult],
) -> None:
    for _ in range(3):
        call("turn")
        call("lift")
    first, second = journal(call, entries=4), journal(call, entries=4, skip=4)
    assert (len(first["entries"]), first["more"]) == (4, 2)
    assert (len(second["entries"]), second["more"]) == (2, 0)
    later = (datetime.now(UTC) + timedelta(hours=1)).isoformat()
    assert journal(call, since=later)["entries"] == []
    assert call("get_journal", since="yesterday").is_error


def test_other_robots_are_told_if_asked_for(
    call: Callable[..., types.CallToolResult], tmp_path: Path
) -> None:
    TaskHistory(tmp_path, robot=lambda: "real robot other").note("hand over", "succeeded", "")
    for tool in ("get_journal", "list_tasks"):
        key = "entries" if tool == "get_journal" else "tasks"
        assert (call(tool).structured_content or {})[key] == []
        (one,) = (call(tool, all_robots=True).structured_content or {})[key]
        assert one["robot"] == "real robot other"


def test_a_motion_that_a_stop_has_ended_is_told_as_stopped(
    application: Application, call: Callable[..., types.CallToolResult]
) -> None:
    async def both() -> None:
        begun, stopping = anyio.Event(), anyio.Event()

        async def swing(_: Turn, context: CallContext) -> Result:
            begun.set()
            await stopping.wait()
            raise StateError("It was stopped.")

        application.tools.add_all([replace(motion("swing"), handler=swing)])
        async with Client(application.server) as client, anyio.create_task_group() as group:
            group.start_soon(client.call_tool, "swing", {})
            await begun.wait()
            await client.call_tool("stop_motion", {})
            stopping.set()

    anyio.run(both)
    told = {entry["tool"]: entry["outcome"] for entry in journal(call)["entries"]}
    assert told == {"swing": "stopped", "stop_motion": "done"}

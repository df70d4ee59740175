"""Tool calls and records of the audit as lines of the page."""

from __future__ import annotations

import html
import json
from types import SimpleNamespace

import anyio
import pytest
from mcp import Client, types
from mcp.server import Server
from view_fakes import profile

from rn_view.diagnostics.event_list import AuditReader, EventList, ToolCalls, add_record
from rn_view.sources.source import ModuleRow, PageState, note_text
from rn_view.visualization.markup import event_rows, joints_table, modules_table, stop_text


def calls(result):
    """Lines listed for one call with that result."""
    events = EventList()
    context = SimpleNamespace(
        method="tools/call", params={"name": "start_robot", "arguments": {"driver": "simulated"}}
    )

    async def answer(_):
        if isinstance(result, Exception):
            raise result
        return result

    async def run():
        return await ToolCalls(events)(context, answer)

    if isinstance(result, Exception):
        with pytest.raises(type(result)):
            anyio.run(run)
    else:
        assert anyio.run(run) is result
    return sorted(events.newest(9), key=lambda event: "..." not in event.text)


def test_a_call_is_listed_when_it_begins_and_ends():
    begun, done = calls({"isError": False, "content": []})
    assert begun.text == 'start_robot(driver="simulated") ...'
    assert "done" in done.text
    assert not done.is_bad


def test_a_refused_call_is_listed_with_its_reason():
    failed = calls({"isError": True, "content": [{"type": "text", "text": "it runs already"}]})[1]
    assert failed.is_bad
    assert "it runs already" in failed.text
    assert calls(ValueError("x"))[1].is_bad


def test_of_tools_that_only_read_only_failures_are_listed():
    def lines(**result):
        events = EventList()
        context = SimpleNamespace(method="tools/call", params={"name": "get_status"})

        async def run():
            async def answer(_):
                return result

            await ToolCalls(events, lambda name: name == "get_status")(context, answer)

        anyio.run(run)
        return events.newest(9)

    assert lines(isError=False) == []
    assert [line.is_bad for line in lines(isError=True, content=[])] == [True]


def test_what_a_client_is_told_is_listed():
    events = EventList()

    async def refuse(context, params):
        return types.CallToolResult(
            content=[types.TextContent(type="text", text="it runs already")], is_error=True
        )

    async def no_tools(context, params):
        return types.ListToolsResult(tools=[])

    server = Server("one", on_call_tool=refuse, on_list_tools=no_tools)
    server.middleware.append(ToolCalls(events))

    async def ask():
        async with Client(server) as client:
            await client.call_tool("start_robot", {})

    anyio.run(ask)
    assert [event.text for event in events.newest(9) if event.is_bad and "it runs" in event.text]


def record(number):
    return {"time_ns": number, "verdict": "refused", "tool": f"tool_{number}", "who": "agent"}


def test_the_audit_is_read_on_across_a_rotation(tmp_path):
    path = tmp_path / "audit.jsonl"
    tail = AuditReader(path)
    assert tail.read_new() == []  # no file yet
    lines = [json.dumps(record(number)) + "\n" for number in range(4)]
    path.write_text(lines[0])
    assert [found["tool"] for found in tail.read_new()] == ["tool_0"]
    with path.open("a") as file:
        file.write(lines[1] + lines[2][:10])
    assert [found["tool"] for found in tail.read_new()] == ["tool_1"]
    with path.open("a") as file:
        file.write(lines[2][10:])
    path.rename(tmp_path / "audit.jsonl.1")
    path.write_text(lines[3])
    assert [found["tool"] for found in tail.read_new()] == ["tool_2", "tool_3"]


def test_a_refusal_is_shown_as_bad():
    events = EventList()
    add_record(events, record(1))
    assert events.newest(1)[0].is_bad


def test_where_the_time_of_a_remote_policy_goes_is_said():
    parts = {"round_trip": "81.4", "link": "60.2", "queue": "0.7", "model": "20.5"}
    metrics = {f"backend.shared.{part}_ms": value for part, value in parts.items()}
    said = "round trip 81 ms: link 60, queue 1, model 20"
    assert note_text("", metrics) == said
    assert note_text("plays", metrics) == f"plays; {said}"
    assert note_text("plays", {}) == "plays"
    assert note_text("plays", metrics | {"backend.shared.link_ms": "?"}) == "plays"


def test_what_somebody_said_never_becomes_html():
    bad = "<script>alert(1)</script>"
    events = EventList()
    events.add("tool", bad)
    row = ModuleRow(kind="robot", health="failing", text=bad, chosen=bad)
    shown = [
        event_rows(events.newest(1)),
        modules_table([row]),
        stop_text(PageState(is_latched=True, cause=bad), "live"),
        joints_table(profile(), {}, (), bad),
    ]
    assert not any("<script" in made for made in shown)


def test_the_joints_say_why_distances_are_not_checked():
    why = "Distances between the links of 'twolink' are not checked."
    assert html.escape(why) in joints_table(profile(), {}, (), why)
    assert why not in joints_table(profile(), {}, ())

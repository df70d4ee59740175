"""Tool calls and records of the audit as lines of the page."""

from __future__ import annotations

import html
import json
from types import SimpleNamespace

import pytest
from view_fakes import profile

from rn_view.diagnostics.event_list import AuditReader, EventList, ToolCalls, add_record
from rn_view.sources.source import ModuleRow, PageState, note_text
from rn_view.visualization.markup import event_rows, joints_table, modules_table, stop_text
from roboneuron.errors import StateError
from roboneuron.server.interception import EndedCall, IncomingCall
from roboneuron.server.tool import Answer


def calls(is_quiet=lambda tool: False, outcome="answered", error=None, structured=None):
    """Lines listed before and after the end of one call."""
    events = EventList()
    call = IncomingCall(
        name="start_robot", arguments={"driver": "simulated"}, context=SimpleNamespace(), found=None
    )
    listener = ToolCalls(events, is_quiet)
    listener.begun(call)
    begun = events.newest(9)
    answer = Answer(structured=structured or {})
    ended = EndedCall(call=call, outcome=outcome, answer=answer, error=error, took_s=0.1)
    listener.ended(ended)
    return begun + events.newest(9)


def test_a_call_is_one_line_while_it_runs_and_after_its_end():
    begun, done = calls()
    assert begun.text == 'start_robot(driver="simulated") ...'
    assert "done" in done.text
    assert not done.is_bad


@pytest.mark.parametrize(
    ("outcome", "is_bad"),
    [("succeeded", False), ("unclear", False), ("failed", True), ("timed_out", True)],
)
def test_the_verdict_of_a_task_is_the_one_that_the_client_got(outcome, is_bad):
    told = {"outcome": outcome, "reason": "the cube is 3 cm up"}
    line = calls(structured=told)[1]
    assert f"{outcome}: the cube is 3 cm up, 0.10 s" in line.text
    assert line.is_bad == is_bad


def test_a_refused_call_is_listed_with_its_reason():
    failed = calls(error=StateError("it runs already"))[1]
    assert failed.is_bad
    assert "it runs already" in failed.text


def test_a_cancelled_call_is_listed_as_bad():
    assert calls(outcome="cancelled")[1].is_bad


def test_of_tools_that_only_read_only_failures_are_listed():
    assert calls(lambda name: name == "start_robot") == []
    failed = calls(lambda name: name == "start_robot", error=StateError("no"))
    assert [line.is_bad for line in failed] == [True]


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

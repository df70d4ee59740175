"""A module whose reports are late for a moment does not flicker on the page."""

from __future__ import annotations

import pytest

from rn_view.diagnostics.event_list import EventList
from rn_view.diagnostics.module_health import JOINED_S, SHORT_S, HealthLines, SteadyHealth
from rn_view.sources.source import ModuleRow


def _row(health, text=""):
    return ModuleRow(kind="perception", health=health, text=text)


def _shown(*steps):
    """Health that the page shows after each step: time [s] and health."""
    steady = SteadyHealth()
    return [steady.rows([_row(health)], at_s)[0].health for at_s, health in steps]


def test_a_short_silence_is_not_shown():
    assert _shown((0.0, "ok"), (0.5, "silent"), (1.0, "silent"), (1.2, "ok")) == ["ok"] * 4


def test_a_lasting_silence_is_shown_and_so_is_its_end():
    steps = [(0.0, "ok"), (1.0, "silent"), (1.0 + SHORT_S, "silent"), (2.2, "ok"), (3.3, "ok")]
    assert _shown(*steps) == ["ok", "ok", "silent", "silent", "ok"]


def test_each_silence_is_timed_by_itself():
    steps = [(0.1 * i, "silent" if i % 2 else "ok") for i in range(60)]
    assert set(_shown(*steps)) == {"ok"}


@pytest.mark.parametrize("health", ["failing", "stalled", "stuck", "exited", "stopped"])
def test_any_other_change_is_shown_at_once(health):
    assert _shown((0.0, "ok"), (0.1, health), (0.2, "ok")) == ["ok", health, "ok"]


def test_a_silence_at_the_start_is_shown_at_once():
    assert _shown((0.0, "silent")) == ["silent"]


def test_the_numbers_of_a_late_module_are_the_newest():
    steady = SteadyHealth()
    steady.rows([_row("ok", "12 images")], 0.0)
    late = ModuleRow(kind="perception", health="silent", text="no report", dropped=7)
    (row,) = steady.rows([late], 0.1)
    assert (row.health, row.text, row.dropped) == ("ok", "12 images", 7)


def test_a_jump_back_in_a_recording_is_shown_at_once():
    assert _shown((50.0, "ok"), (50.2, "silent"), (3.0, "silent")) == ["ok", "ok", "silent"]


def _lines(*changes, module="perception"):
    """Lines for these changes (time [s], health before and after), newest first."""
    now = [0.0]
    events = EventList(clock=lambda: now[0])
    lines = HealthLines(events)
    for now[0], before, health in changes:
        lines.add(module, health, before=before)
    return [(event.text, event.is_bad) for event in events.newest(9)]


def test_a_fault_is_a_line_but_no_start_and_no_stop():
    assert _lines((0.0, "ok", "failing")) == [("perception: failing (was ok)", True)]
    steps = [(0.0, "stopped", "starting"), (1.0, "starting", "ok"), (2.0, "ok", "stopped")]
    assert _lines(*steps) == []


def _flicker(fault):
    return [(0.1 * i, *(("ok", fault) if i % 2 == 0 else (fault, "ok"))) for i in range(40)]


def test_changes_close_together_share_a_line():
    assert _lines(*_flicker("failing")) == [("perception: ok (failing 20 times in 4 s)", False)]


def test_short_silences_leave_no_line():
    assert _lines(*_flicker("silent")) == []


def test_a_shared_line_is_red_while_the_fault_lasts_and_names_each_fault():
    changes = [(0.0, "ok", "silent"), (1.0, "silent", "ok"), (2.0, "ok", "failing")]
    assert _lines(*changes) == [("perception: failing (silent once, failing once in 2 s)", True)]


def test_changes_far_apart_have_lines_of_their_own():
    later_s = 1.0 + JOINED_S
    changes = [(0.0, "ok", "silent"), (later_s, "silent", "ok")]
    assert _lines(*changes) == [
        ("perception: ok (was silent)", False),
        ("perception: silent (was ok)", True),
    ]


def test_a_line_that_has_left_the_list_is_not_missed():
    now = [0.0]
    events = EventList(clock=lambda: now[0], kept=2)
    lines = HealthLines(events)
    lines.add("robot", "silent", before="ok")
    for index in range(3):
        events.add("tool", f"call {index}")
    now[0] = 1.0
    lines.add("robot", "ok", before="silent")
    assert events.newest(1)[0].text == "robot: ok (silent once in 1 s)"
    assert len(events.newest(9)) == 2


def test_modules_do_not_share_lines():
    events = EventList(clock=lambda: 0.0)
    lines = HealthLines(events)
    lines.add("robot", "silent", before="ok")
    lines.add("control", "silent", before="ok")
    assert len(events.newest(9)) == 2

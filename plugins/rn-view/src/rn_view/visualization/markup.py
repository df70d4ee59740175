"""Texts and tables of the page as HTML. Text from outside is escaped."""

from __future__ import annotations

import html
import math
import time
from collections.abc import Mapping, Sequence

from rn_view.diagnostics.event_list import ShownEvent
from rn_view.recordings.playback import Mark, Playback
from rn_view.sources.source import ModuleRow, PageState
from roboneuron import (
    RobotProfile,
    foreign,
)
from roboneuron.feature import EXPLANATIONS, FAULTS

_GOOD, _IDLE = "light-dark(#237032, #69db7c)", "light-dark(#555c63, #ced4da)"
_BAD, _STARTING = "light-dark(#b01e1e, #ff8787)", "light-dark(#9c5200, #ffc078)"
"""For a light and a dark page, each with a contrast above 5. Source: WCAG 2.2, success criterion
1.4.3 (AA: 4.5).
"""
_ALARM = "#b01e1e"
"""Background of white text."""
_SMALL = "font-size:12px;line-height:1.35"
STYLE = (
    '<style>@media (max-width: 36em) {div[style*="width: 20em"] {width: 100% !important}}</style>'
)
"""On a phone viser 1.1 makes the panel 20em wide. This makes it as wide as the page."""
_MOST_TEXT = 2000
_NEAR = 0.05
"""Share of a joint's range within which it is shown as near its limit."""


def escape(text: str) -> str:
    """Text from outside as HTML: without markup, and without what reverses or hides text."""
    return html.escape(foreign.printable(text, _MOST_TEXT))


def stop_text(snapshot: PageState | None, label: str) -> str:
    """State of the emergency stop; `label` is the kind of view."""
    if snapshot is None:
        return _line("", label)
    if not snapshot.is_latched:
        return _line("", f"{escape(label)} &middot; emergency stop not pressed")
    cause = f": {escape(snapshot.cause)}" if snapshot.cause else ""
    return (
        f'<div style="{_SMALL};padding:6px 14px;background:{_ALARM};color:white"><b>EMERGENCY STOP '
        f"LATCHED</b>{cause}. Check the robot. Then a person releases the stop with the command at "
        "the top of this page.</div>"
    )


def full_text(most: int) -> str:
    """Message on a page beyond the maximum number, which shows only the emergency stop."""
    return _line(
        "font-size:14px",
        f"{most} pages are open, the limit <code>max_viewers</code> of [view]. This page has only "
        "the emergency stop. Close another page, then reload this one.",
    )


def recording_text(playback: Playback, snapshot: PageState | None) -> str:
    """Title of the recording, the time shown, and whether the emergency stop was latched at that
    time.
    """
    at_s = playback.begun_s + playback.position_s
    moment = f"{time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(at_s))}.{int(at_s * 10) % 10}"
    text = (
        f"<b>Recording</b> {escape(playback.title)}<br>{moment} &middot; no robot is connected "
        "to this page"
    )
    if snapshot is not None and snapshot.is_latched:
        text += f'<br><b style="color:{_BAD}">Emergency stop latched: {escape(snapshot.cause)}</b>'
    return f'<div style="{_SMALL};padding:4px 14px;overflow-wrap:anywhere">{text}</div>'


def mark_text(mark: Mark, position_s: float) -> str:
    """Newest mark before the position, and the time since then."""
    return _line(
        "overflow-wrap:anywhere", f"{position_s - mark.at_s:.1f} s after {escape(mark.text[:160])}"
    )


def instruction_text(snapshot: PageState) -> str:
    """The present instruction of the policy, and why the robot does not move."""
    text = escape(snapshot.instruction) or "none"
    rows = "".join(
        f"<li>{escape(reason.message)} <i>{escape(reason.hint)}</i></li>"
        for reason in snapshot.why_still
    )
    why = f'<div style="{_SMALL}">It does not move:<ol>{rows}</ol></div>' if rows else ""
    return f'<div style="padding:4px 14px;font-size:14px">Instruction: <b>{text}</b>{why}</div>'


def modules_table(rows: Sequence[ModuleRow]) -> str:
    """Health, rates, latencies, ages and drops of the modules."""
    head = "".join(
        f'<th style="text-align:{"left" if not i else "right"};font-weight:500;color:{_IDLE}">'
        f"{word}</th>"
        for i, word in enumerate(("module", "Hz", "ms", "p99", "age", "drops"))
    )
    body = "".join(_module_rows(row) for row in rows)
    return (
        f'<table style="{_SMALL};width:100%;padding:0 12px;border-spacing:2px '
        f'1px"><tr>{head}</tr>{body}</table>'
    )


def _module_rows(row: ModuleRow) -> str:
    colour = _BAD if row.health in FAULTS else _GOOD if row.health == "ok" else _IDLE
    colour = _STARTING if row.health in ("starting", "stopping", "waiting") else colour
    meaning = EXPLANATIONS.get(row.health, "")  # type: ignore[call-overload]
    dot = f'<span style="color:{colour}" title="{escape(meaning)}">&#9679;</span>'
    numbers = (row.rate_hz, row.latency_ms, row.latency_p99_ms, row.age_ms)
    cells = "".join(f'<td style="text-align:right">{_number(number)}</td>' for number in numbers)
    chosen = f' <span style="color:{_IDLE}">{escape(row.chosen)}</span>' if row.chosen else ""
    told = (
        f"{row.health}: {row.text}" if row.text and row.health != "ok" else row.text or row.health
    )
    told = "" if told == "ok" else told
    colour = _BAD if row.health in FAULTS else _IDLE
    return (
        f"<tr><td>{dot} <b>{escape(row.kind)}</b>{chosen}</td>{cells}"
        f'<td style="text-align:right">{row.dropped}</td></tr>'
        f'<tr><td colspan="6" style="color:{colour};padding:0 0 2px '
        f'14px">{escape(told[:160])}</td></tr>'
    )


def joints_table(
    profile: RobotProfile,
    joints: Mapping[str, float],
    limited: Sequence[str] = (),
    unchecked: str = "",
) -> str:
    """Position of each joint within its limits, and why distances of links are not checked."""
    limits = profile.limits
    if limits is None:
        return _line("", "This robot has no arm joints.")
    rows = []
    for name, lower, upper in zip(profile.arm_joints, limits.lower, limits.upper, strict=True):
        at = joints.get(name)
        if at is not None and not math.isfinite(upper - lower):  # it turns without end
            at = profile.kinds.nearest(name, 0.0, at)
            upper = math.pi / (1.0 - 2.0 * _NEAR)
            lower = -upper
        share = 0.0 if at is None else (at - lower) / (upper - lower)
        colour = _BAD if at is not None and not _NEAR < share < 1.0 - _NEAR else "#228be6"
        mark = (
            ""
            if at is None
            else f'<div style="position:absolute;left:{100 * min(1.0, max(0.0, share)):.1f}%;'
            "top:-3px;width:4px;"
            f'height:12px;margin-left:-2px;background:{colour}"></div>'
        )
        bar = (
            '<div style="position:relative;height:6px;background:#dee2e6;border-radius:3px">'
            f"{mark}</div>"
        )
        acts = f' <b style="color:{_BAD}">limit</b>' if name in limited else ""
        rows.append(
            f'<tr><td style="white-space:nowrap">{escape(name)}{acts}</td><td '
            f'style="width:45%">{bar}</td>'
            f'<td style="text-align:right">{_number(at, 2)}</td></tr>'
        )
    note = _line(f"color:{_BAD};white-space:normal", escape(unchecked)) if unchecked else ""
    return f'<table style="{_SMALL};width:100%;padding:0 12px">{"".join(rows)}</table>{note}'


def event_rows(events: Sequence[ShownEvent]) -> str:
    """The newest events, one line each."""
    if not events:
        return _line("", "No events yet.")
    rows = "".join(
        '<div style="padding:1px '
        f'0;overflow-wrap:anywhere;color:{_BAD if event.is_bad else "inherit"}">'
        f'<span style="color:{_IDLE}">{time.strftime("%H:%M:%S", time.localtime(event.at_s))} '
        f"{escape(event.what)}</span> {escape(event.text)}</div>"
        for event in events
    )
    return f'<div style="{_SMALL};padding:2px 14px">{rows}</div>'


def _line(style: str, html: str) -> str:
    return f'<div style="{_SMALL};padding:2px 14px;color:{_IDLE};{style}">{html}</div>'


def _number(value: float | None, digits: int = 1) -> str:
    return "" if value is None else f"{value:.{digits}f}"

"""A person says in the page how a recording went, by keyboard alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from view_fakes import FakeOperator
from view_page import LEAST_CONTRAST, TEXT_CONTRAST, wait_until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.filterwarnings("default:Queued a:UserWarning"),
]
RUNS = [
    {
        "id": "20260102-090000-second",
        "kind": "recording",
        "begun_at": "2026-01-02T09:00:00+00:00",
        "state": "recording",
        "outcome": "unknown",
        "note": "",
    },
    {
        "id": "20260102-080500-pick",
        "kind": "recording",
        "begun_at": "2026-01-02T08:05:00+00:00",
        "state": "finished",
        "outcome": "unknown",
        "note": "",
    },
    {
        "id": "20260102-080000-control-silent",
        "kind": "incident",
        "begun_at": "2026-01-02T08:00:00+00:00",
        "state": "finished",
        "outcome": "",
        "note": "control-silent",
    },
    {
        "id": "20260101-070000-first",
        "kind": "recording",
        "begun_at": "2026-01-01T07:00:00+00:00",
        "state": "finished",
        "outcome": "failure",
        "note": "<b>dropped</b> it",
    },
]


@pytest.fixture
def recorded(operator: FakeOperator) -> FakeOperator:
    """An operator whose server has a recorder."""
    operator.tools = {"label_recording": {}, "list_recordings": {"runs": RUNS}}
    return operator


def labels_of(operator: FakeOperator) -> list[dict[str, Any]]:
    """Labels stored so far."""
    return [given for _, tool, given in operator.calls if tool == "label_recording"]


def test_a_recording_is_labelled_by_keyboard_alone(
    serve: Callable[..., Any], look: Callable[..., Any], recorded: FakeOperator
) -> None:
    page = look(serve().url)
    opener = page.get_by_role("button", name="Label a recording")
    opener.wait_for()
    opener.press("Enter")
    runs = page.get_by_role("combobox", name="Recording")
    page.get_by_role("option", name="20260102-080500-pick").wait_for(state="attached")
    assert [one.get_attribute("value") for one in runs.locator("option").all()] == [
        "20260102-080500-pick",
        "20260101-070000-first",
    ]
    assert runs.evaluate("one => one === document.activeElement")
    page.keyboard.press("Tab")
    page.keyboard.press("ArrowUp")
    page.keyboard.press("ArrowUp")
    assert page.get_by_role("radio", name="Success").is_checked()
    page.keyboard.press("Tab")
    assert page.get_by_role("textbox", name="Comment").evaluate(
        "one => one === document.activeElement"
    )
    page.keyboard.type("turned the cube")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.locator("#rn-label-say[role=status]").get_by_text("Saved: 20260102-080500-pick").wait_for()
    assert labels_of(recorded) == [
        {"run": "20260102-080500-pick", "outcome": "success", "comment": "turned the cube"}
    ]
    page.keyboard.press("Escape")
    assert opener.evaluate("one => one === document.activeElement")


def test_another_recording_is_shown_as_it_was_labelled_and_a_refusal_is_told(
    serve: Callable[..., Any], look: Callable[..., Any], recorded: FakeOperator
) -> None:
    recorded.refusal = "ann operates the robot. Call take_over."
    page = look(serve().url)
    page.locator("#rn-label-open").click()
    page.get_by_label("Recording", exact=True).select_option("20260101-070000-first")
    assert page.get_by_label("Failure").is_checked()
    assert page.get_by_label("Comment").input_value() == "<b>dropped</b> it"
    page.get_by_role("button", name="Save the label").click()
    page.get_by_text("ann operates the robot").wait_for()
    page.get_by_role("button", name="Become the operator").click()
    page.get_by_text("You are the operator now. Save the label.").wait_for()
    recorded.refusal = ""
    page.get_by_role("button", name="Save the label").click()
    page.get_by_text("Saved: 20260101-070000-first").wait_for()
    wait_until(lambda: recorded.calls[-2][1] == "take_over")


def test_a_server_without_a_recorder_and_a_viewer_have_no_form(
    serve: Callable[..., Any], look: Callable[..., Any], operator: FakeOperator
) -> None:
    page = look(serve().url)
    page.locator("#rn-lead-open").wait_for(state="visible")
    assert not page.locator("#rn-label-open").is_visible()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(1280, 800), (390, 844)], ids=["desk", "phone"])
def test_both_panels_can_be_read_by_day_and_night(
    serve: Callable[..., Any],
    look: Callable[..., Any],
    recorded: FakeOperator,
    scheme: str,
    size: tuple[int, int],
) -> None:
    page = look(serve().url)
    page.set_viewport_size({"width": size[0], "height": size[1]})
    page.emulate_media(color_scheme=scheme)
    page.locator("#rn-label-open").click()
    page.get_by_role("option", name="20260101").wait_for(state="attached")
    for box, closer in (("rn-label-box", "rn-label-close"), ("rn-lead-box", "rn-lead-close")):
        shown = page.locator(f"#{box}")
        shown.wait_for(state="visible")
        assert LEAST_CONTRAST <= page.evaluate(TEXT_CONTRAST, box) < 22
        place = shown.bounding_box()
        assert place["x"] >= 0
        assert place["x"] + place["width"] <= size[0]
        assert place["y"] + place["height"] <= size[1]
        page.locator(f"#{closer}").click()
        if box == "rn-label-box":
            page.locator("#rn-lead-open").click()

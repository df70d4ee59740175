"""The panel in a real browser: stick, keys and joint buttons become samples, and what control says
is shown.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from view_fakes import FakeOperator
from view_page import wait_until

from rn_standard.teleoperation.samples import LeadFeedback, LeadSample
from rn_view.teleoperation.sample_socket import PageTeleoperator

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.filterwarnings("default:Queued a:UserWarning"),
]


def leading(page: Any, operator: FakeOperator) -> PageTeleoperator:
    """A page that leads."""
    page.locator("#rn-lead-open").wait_for(state="visible")
    page.locator("#rn-lead-open").click()
    page.locator("#rn-lead-go:enabled").click()
    page.get_by_text("You lead.").wait_for()
    (source,) = [source for source in operator.lent.values() if source is not None]
    return source


def sample_until(source: PageTeleoperator, is_so: Callable[[LeadSample], bool]) -> LeadSample:
    """The first sample that meets the condition."""
    found: list[LeadSample] = []

    def look() -> bool:
        sample = source.read(0.5)
        if sample is not None and is_so(sample):
            found.append(sample)
        return bool(found)

    wait_until(look)
    return found[0]


def test_sticks_keys_and_joints_of_a_page_become_samples(
    serve: Callable[..., Any], look: Callable[..., Any], operator: FakeOperator
) -> None:
    page = look(serve().url)
    source = leading(page, operator)
    assert operator.calls[-1][1:] == (
        "lead_arm",
        {"source": next(iter(operator.lent)), "mode": "person", "scale": 0.5},
    )
    assert not sample_until(source, lambda sample: True).is_held

    box = page.locator("#rn-stick-a").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"])
    pushed = sample_until(source, lambda one: one.is_held and one.twist[0] > 0.2)
    assert pushed.twist.tolist() == pytest.approx([0.25, 0, 0, 0, 0, 0], abs=0.01)
    source.tell(
        LeadFeedback(
            number=pushed.number, who="person", limits="workspace", note="Too far", delay_s=0.01
        )
    )
    page.get_by_text("Limit: workspace. Too far").wait_for()
    page.locator("#rn-lead-numbers").get_by_text("p99").wait_for()
    page.mouse.up()
    assert not sample_until(source, lambda one: not one.is_held).twist.any()

    page.keyboard.down("KeyW")
    assert not sample_until(source, lambda one: one.twist[0] > 0.2).is_held
    page.keyboard.down("Space")
    sample_until(source, lambda one: one.is_held and one.twist[0] > 0.2)
    page.keyboard.up("Space")
    page.keyboard.up("KeyW")

    page.locator("#rn-joint-more").hover()
    page.mouse.down()
    jogged = sample_until(source, lambda one: one.is_held)
    assert jogged.velocities == {"turn": pytest.approx(0.5)}
    page.mouse.up()

    page.locator("#rn-lead-back").click()
    wait_until(lambda: operator.calls[-1][1] == "hand_back")
    source.ended("")
    page.get_by_text("Handed back.").wait_for()


def test_a_page_that_is_closed_or_floods_loses_the_lead(
    serve: Callable[..., Any], look: Callable[..., Any], operator: FakeOperator
) -> None:
    page = look(serve().url)
    source = leading(page, operator)
    sample_until(source, lambda sample: True)
    page.evaluate(
        "() => { for (let n = 0; n < 1000; n++) rnLead.send({n: 1e6 + n, t: 1, held: true}); }"
    )
    page.get_by_text("The connection is lost").wait_for()
    with pytest.raises(Exception, match=r"sends too many|has disconnected"):
        wait_until(lambda: source.read(0.2) is None)


def test_a_gamepad_without_numbers_is_told_as_it_is(
    serve: Callable[..., Any], look: Callable[..., Any], operator: FakeOperator
) -> None:
    page = look(serve().url)
    source = leading(page, operator)
    page.evaluate(
        """() => { navigator.getGamepads = () => [null, {connected: true, axes: [NaN, Infinity, 0],
        buttons: [0, 0, 0, 0, 1].map(pressed => ({pressed: !!pressed}))}]; }"""
    )
    sample = sample_until(source, lambda one: one.is_held)
    assert np.isnan(sample.twist[:2]).all()


def test_thousands_of_keys_make_no_more_samples(
    serve: Callable[..., Any], look: Callable[..., Any], operator: FakeOperator
) -> None:
    page = look(serve().url)
    source = leading(page, operator)
    before = sample_until(source, lambda one: True).number
    took_ms = page.evaluate(
        """() => { const begun = performance.now();
        for (let n = 0; n < 5000; n++) for (const word of ["keydown", "keyup"])
          dispatchEvent(new KeyboardEvent(word, {code: "KeyW", bubbles: true}));
        dispatchEvent(new KeyboardEvent("keydown", {code: "KeyW"}));
        return performance.now() - begun; }"""
    )
    after = sample_until(source, lambda one: one.twist[0] > 0.2)
    assert not after.is_held
    assert after.number - before < 500 + took_ms
    assert page.get_by_text("You lead.").is_visible()

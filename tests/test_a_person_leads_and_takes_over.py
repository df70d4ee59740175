"""A scripted person on the page's websocket leads a simulated FR3, takes over from its policy, and
gets disconnected.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from lead_client import LeadPage
from led_cell import INSTRUCTION, STILL, Cell

from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.timing,
    pytest.mark.timeout(240),
    pytest.mark.filterwarnings("default:Queued a:UserWarning"),
]
AHEAD, LEFT = [0.1, 0, 0, 0, 0, 0], [0, 0.1, 0.05, 0, 0, 0]
LIMITS = (2.62, 10.0)
"""Limits of the FR3's slower joints [rad/s, rad/s^2]."""
SPACING_S = 0.02
REST_M_S = 0.005
REST_S = 0.2
"""Time from the last sample of a disconnected person to the arm at rest."""
OBSERVED_S = 0.06
"""Additional delay of an observer: poses come every 25 ms, on a shared machine."""


@pytest.fixture
def cell(environment: dict[str, str], tmp_path: Path) -> Iterator[Cell]:
    with ExitStack() as stack:
        made = Cell(environment, tmp_path, stack)
        for module in ("robot", "control"):
            made.call(f"start_{module}")
        yield made
        made.call("stop_all")


def test_bad_input_brakes_the_arm_and_says_what_to_do(cell: Cell) -> None:
    with LeadPage(cell.url) as page:
        for bad, told, remedy in (
            ({"twist": [None, 0, 0, 0, 0, 0]}, "not finite", "again"),
            ({"twist": [1e9, 0, 0, 0, 0, 0]}, "no person means", "again"),
            ({"t": time.monotonic() - 3600.0}, "clock of the source is wrong", "again"),
            ({"twist": "left"}, "an invalid sample", "Reload the page"),
        ):
            assert page.lead() == ""
            page.press()
            page.push(AHEAD, 0.3)
            page.send(**{"twist": AHEAD, **bad})
            sent_s = time.monotonic()
            wait_until(lambda: not page.is_led, 10.0, poll_s=0.01)
            assert told in page.text
            assert remedy in page.text
            wait_until(lambda: cell.poses[-1][0] > sent_s + 0.6, 10.0, poll_s=0.05)  # noqa: B023
            assert cell.speed_m_s(sent_s + REST_S + OBSERVED_S) < REST_M_S
            assert "the lead was lost" in cell.module("control")["needs_start"]


def test_the_arm_follows_a_page_and_rests_when_it_is_lost(cell: Cell) -> None:
    with LeadPage(cell.url) as page, LeadPage(cell.url) as other:
        assert page.lead() == ""
        assert "operates the robot" in other.lead(operate=False)
        other.push(LEFT, 0.1)
        wait_until(lambda: len(cell.poses) > 5, 10.0, poll_s=0.05)
        moved = follow(cell, page)
        assert moved[0] < 0.11
        assert moved[1:] == pytest.approx([0.0, 0.0], abs=0.01)
        assert page.echoes[-1][1:4] == ("person", "", "the switch is released")
        other.ask({"operate": 1})
        wait_until(lambda: not page.is_led, 10.0)
        assert "operates the robot" in page.text
        assert other.lead() == ""
        follow(cell, other)
        other.push(AHEAD, 0.5)
        lost_s = time.monotonic()
    wait_until(lambda: cell.poses[-1][0] > lost_s + 1.0, 10.0, poll_s=0.05)
    assert cell.speed_m_s(lost_s + REST_S + OBSERVED_S) < REST_M_S
    assert "the lead was lost" in cell.module("control")["needs_start"]
    assert "Nobody leads" in cell.refusal("hand_back")


def test_a_person_takes_over_corrects_and_hands_back(cell: Cell) -> None:
    cell.call("start_perception")
    cell.call("start_inference", instruction=INSTRUCTION)
    wait_until(lambda: bool(cell.acting), 20.0, poll_s=0.02)
    begun = len(cell.joints)
    wait_until(lambda: len(cell.joints) > begun + 60, 20.0, poll_s=0.02)
    _, usual = greatest(cell.joints[begun:])
    with LeadPage(cell.url) as page:
        for mode in ("person", "blend"):
            wait_until(lambda: cell.acting[-1].who == "policy", 20.0, poll_s=0.02)
            before = len(cell.joints), len(cell.acting)
            assert page.lead(mode) == ""
            page.press()
            page.push(LEFT, 0.6)
            assert page.ask({"back": 1}) == ""
            assert mode in {acting.who for acting in cell.acting[before[1] :]}
            wait_until(lambda: cell.acting[-1].who == "policy", 20.0, poll_s=0.02)
            assert cell.module("inference")["instruction"] == INSTRUCTION
            velocity, acceleration = greatest(cell.joints[before[0] :])
            assert velocity < LIMITS[0]
            # second differences of positions; the policy alone causes as much
            assert acceleration < 2.0 * max(usual, 3.0 * LIMITS[1])
    assert cell.module("control")["dropped_by"]["taken_over"] > 0


def follow(cell: Cell, page: LeadPage) -> np.ndarray:
    """Distance of the arm after pushing it forwards for a second [m].

    On a busy machine samples may come so late that the lead brakes, and the switch is needed again.
    """
    for _ in range(8):
        page.press()
        start = cell.poses[-1][1]
        page.push(AHEAD, 1.0)
        page.push(STILL, 0.5, held=False)
        moved = cell.poses[-1][1] - start
        if moved[0] > 0.04:
            return np.array(moved)
    pytest.fail(f"the arm does not follow: {page.echoes[-20:]}")


def greatest(joints: list[tuple[float, np.ndarray]]) -> tuple[float, float]:
    """Maximum velocity [rad/s] and acceleration [rad/s^2] of measured joints."""
    apart = joints[:1]
    for (
        at,
        place,
    ) in joints:  # close stamps amplify small errors
        if at - apart[-1][0] >= SPACING_S:
            apart.append((at, place))
    times, places = np.array([at for at, _ in apart]), np.array([place for _, place in apart])
    steps = np.diff(times)[:, None]
    velocities = np.diff(places, axis=0) / steps
    accelerations = np.diff(velocities, axis=0) / steps[1:]
    return float(np.abs(velocities).max()), float(np.abs(accelerations).max())

"""What a gamepad gives that no person means: numbers that are not finite."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "plugins" / "rn-view" / "tests"))
sys.path.insert(0, str(Path(__file__).parent))
from lead_client import LeadPage
from led_cell import Cell

sys.path.pop(0)
sys.path.pop(0)

from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.timing,
    pytest.mark.timeout(240),
    pytest.mark.filterwarnings("default:Queued a:UserWarning"),
]
AHEAD = [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]
REST_M_S, REST_S, OBSERVED_S = 0.005, 0.2, 0.06
"""As in test_a_person_leads_and_takes_over.py."""
MOVED_M = 0.03


@contextmanager
def served(environment: dict[str, str], tmp_path: Path, more: str = "") -> Iterator[Cell]:
    with ExitStack() as stack:
        cell = Cell(environment, tmp_path, stack, more)
        for module in ("robot", "control"):
            cell.call(f"start_{module}")
        yield cell
        cell.call("take_over")
        cell.call("stop_all")


def check_rests(cell: Cell, since_s: float) -> None:
    """The arm rests in time, and until a new start."""
    wait_until(lambda: cell.poses[-1][0] > since_s + 1.2, 10.0, poll_s=0.05)
    assert cell.speed_m_s(since_s + REST_S + OBSERVED_S) < REST_M_S
    assert "the lead was lost" in cell.module("control")["needs_start"]


def pushed(cell: Cell, push: Callable[[], object]) -> None:
    """Push until the arm has moved: on a busy machine samples may come so late that it brakes."""
    wait_until(lambda: bool(cell.poses), 10.0)
    for _ in range(8):
        start = cell.poses[-1][1]
        push()
        if abs(cell.poses[-1][1] - start).max() > MOVED_M:
            return
    pytest.fail("the arm does not follow")


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        ({"twist": [float("inf"), 0, 0, 0, 0, 0]}, "not finite"),
        ({"twist": [float("-inf"), 0, 0, 0, 0, 0], "tool": True}, "not finite"),
        ({"twist": None, "joint": ["fr3_joint1", None]}, "not finite"),
        ({"grip": float("nan")}, "not finite"),
        ({"grip": 7.0}, "opening of 7"),
    ],
    ids=["inf", "-inf", "joint-nan", "grip-nan", "grip-7"],
)
def test_a_gamepad_that_gives_no_number_brakes_the_arm(
    environment: dict[str, str], tmp_path: Path, bad: dict[str, object], told: str
) -> None:
    with served(environment, tmp_path) as cell, LeadPage(cell.url) as page:
        assert page.lead() == ""

        def push() -> None:
            page.press()
            page.push(AHEAD, 0.6)

        pushed(cell, push)
        page.send(**{"twist": AHEAD, **bad})  # type: ignore[arg-type]
        check_rests(cell, time.monotonic())
        assert not page.is_led
        assert told in page.text

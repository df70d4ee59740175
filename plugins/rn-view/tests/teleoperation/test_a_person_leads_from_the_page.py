"""The sliders of a page as a leader arm: served on request, bounded, and gone with the page."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
from page_client import PageClient
from view_fakes import HOME, joints, profile
from view_page import wait_until

from rn_testing.waiting import wait_for_line
from rn_view.teleoperation.slider_goal import LEAD_PATH, RENEWED_S, SliderGoal
from roboneuron import NotReadyError, RefusedError

pytestmark = [pytest.mark.timeout(120), pytest.mark.filterwarnings("default:Queued a:UserWarning")]
SWITCH = "Lead with these sliders"
VIEWER, OPERATOR = ("a-token-for-looking-1", "viewer"), ("a-token-for-acting-22", "operator")
PAGE = """
import sys, time
sys.path.insert(0, sys.argv[1])
from page_client import PageClient
page = PageClient(sys.argv[2])
while "Lead with these sliders" not in page.labels: time.sleep(0.02)
page.choose("Lead with these sliders", True)
print("leads", flush=True)
while True:  # a busy machine may have ended the lead: whoever leads presses again
    time.sleep(1.0)
    page.choose("Lead with these sliders", True)
"""


class Clock:
    """Time that the test sets [s]."""

    now_s = 10.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def lead(clock: Clock) -> SliderGoal:
    """The lead of an arm whose joint speeds are limited to 2 rad/s."""
    return SliderGoal(profile(), clock)


def ask(url: str, robot: str = "twolink", **headers: str) -> tuple[int, dict]:
    """Status and body of the answer."""
    request = Request(f"{url}{LEAD_PATH}?robot={robot}", headers=headers)
    try:
        with urlopen(request, timeout=20) as answer:
            return answer.status, json.load(answer)
    except HTTPError as error:
        return error.code, json.load(error)


def test_the_goal_starts_at_the_arm_and_moves_at_a_quarter_of_its_speed(
    lead: SliderGoal, clock: Clock
) -> None:
    assert lead.goal(HOME) is None
    assert lead.begin("page", HOME) == HOME
    lead.aim("page", "turn", 1.3)
    measured = dict(HOME)
    for _ in range(10):
        clock.now_s += 0.05
        assert lead.renew("page")
        goal = lead.goal(measured)
        assert goal is not None
        assert goal["turn"] - measured["turn"] == pytest.approx(0.25 * 2.0 * 0.05)
        assert goal["lift"] == HOME["lift"]
        measured = goal


def test_the_goal_stays_near_an_arm_that_is_held_back(lead: SliderGoal, clock: Clock) -> None:
    lead.begin("page", HOME)
    lead.aim("page", "turn", -9.0)
    for _ in range(100):
        clock.now_s += 0.05
        lead.renew("page")
        goal = lead.goal(HOME)
    assert goal is not None
    assert goal["turn"] == pytest.approx(HOME["turn"] - 0.1)
    # what is wanted beyond a limit is the limit, and the arm gets there once it is free
    for _ in range(200):
        clock.now_s += 0.05
        lead.renew("page")
        goal = lead.goal(goal)
    assert goal["turn"] == -2.0


def test_a_pause_in_asking_makes_no_jump(lead: SliderGoal, clock: Clock) -> None:
    lead.begin("page", HOME)
    lead.aim("page", "turn", 2.0)
    clock.now_s += RENEWED_S - 0.01
    goal = lead.goal(HOME)
    assert goal is not None
    assert goal["turn"] - HOME["turn"] == pytest.approx(0.25 * 2.0 * 0.1)


def test_one_page_leads_until_it_ends_or_is_not_there(lead: SliderGoal, clock: Clock) -> None:
    lead.begin("one", HOME)
    with pytest.raises(RefusedError, match="Another page leads this robot"):
        lead.begin("two", HOME)
    lead.aim("two", "turn", 2.0)
    lead.end("two")
    clock.now_s += 0.05
    assert lead.goal(HOME) == HOME
    clock.now_s += RENEWED_S
    assert lead.goal(HOME) is None
    assert not lead.renew("one")
    lead.begin("two", HOME)
    lead.end("two")
    assert lead.goal(HOME) is None


def test_a_joint_that_is_not_measured_is_named(lead: SliderGoal) -> None:
    with pytest.raises(NotReadyError, match="does not report lift"):
        lead.begin("page", {"turn": 0.0})


def leading(serve, source) -> tuple[str, PageClient]:
    """A page that leads the arm from `HOME`."""
    url = serve().url
    page = PageClient(url)
    wait_until(lambda: SWITCH in page.labels and "joint_states" in source.subscribed)
    assert ask(url) == (409, {"text": "No page leads this robot"})
    source.send("joint_states", joints(**HOME))
    page.choose(SWITCH, True)
    wait_until(lambda: ask(url)[0] == 200)
    return url, page


def test_the_sliders_of_a_page_are_served_while_it_is_open(serve, source) -> None:
    url, page = leading(serve, source)
    assert ask(url)[1]["positions"] == pytest.approx(HOME)
    page.choose("turn [deg]", 20.0)
    wait_until(lambda: ask(url)[1]["positions"]["turn"] > HOME["turn"] + 0.01)
    wait_until(
        lambda: ask(url)[1]["positions"]["turn"] == pytest.approx(math.radians(20.0)),
    )
    assert ask(url)[1]["positions"]["lift"] == pytest.approx(HOME["lift"])
    assert ask(url, "other") == (
        404,
        {"text": "There is no robot 'other'; this view shows twolink"},
    )
    page.choose(SWITCH, False)
    wait_until(lambda: ask(url)[0] == 409)
    page.choose(SWITCH, True)
    wait_until(lambda: ask(url)[0] == 200)
    page.close()
    wait_until(lambda: ask(url)[0] == 409)


def test_a_page_leads_on_while_its_browser_answers_and_not_after(serve, source) -> None:
    url = serve().url
    with subprocess.Popen(
        [sys.executable, "-c", PAGE, str(Path(__file__).parents[1]), url],
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            wait_until(lambda: "joint_states" in source.subscribed)
            source.send("joint_states", joints(**HOME))
            wait_for_line(process.stdout, "leads")
            wait_until(lambda: ask(url)[0] == 200)
            process.send_signal(signal.SIGSTOP)
            wait_until(lambda: ask(url)[0] == 409)
        finally:
            process.kill()


def test_a_viewer_has_no_sliders_and_a_token_is_needed_to_read_them(serve, source) -> None:
    url = serve(VIEWER, OPERATOR).url
    page = PageClient(url)
    wait_until(lambda: "Token" in page.labels)
    page.choose("Token", VIEWER[0])
    page.choose("Show the robot", True)
    wait_until(lambda: "lift the" in page.text)
    assert SWITCH not in page.labels
    page.close()
    page = PageClient(url)
    wait_until(lambda: "Token" in page.labels)
    page.choose("Token", OPERATOR[0])
    page.choose("Show the robot", True)
    wait_until(lambda: SWITCH in page.labels)
    source.send("joint_states", joints(**HOME))
    page.choose(SWITCH, True)
    wait_until(lambda: ask(url, Authorization=f"Bearer {VIEWER[0]}")[0] == 200)
    assert ask(url)[0] == 401
    assert ask(url, Authorization="Bearer nobody")[0] == 401
    page.close()


def endless(clock: Clock) -> SliderGoal:
    """The lead of an arm whose first joint turns without end."""
    robot = profile()
    assert robot.limits is not None
    lower, upper = robot.limits.lower.copy(), robot.limits.upper.copy()
    lower[0], upper[0] = -math.inf, math.inf
    urdf = robot.urdf.replace('name="turn" type="revolute"', 'name="turn" type="continuous"')
    limits = replace(robot.limits, lower=lower, upper=upper)
    return SliderGoal(replace(robot, urdf=urdf, limits=limits), clock)


@pytest.mark.parametrize("turns", [-2, 0, 1])
@pytest.mark.parametrize(("aim", "moves"), [(3.1, -0.043), (-3.1, 0.04), (-2.9, 0.05)])
def test_a_slider_of_an_endless_joint_goes_the_shorter_way_from_any_turn(
    clock: Clock, turns: int, aim: float, moves: float
) -> None:
    """At a quarter of 2 rad/s, for a tenth of a second."""
    lead, start = endless(clock), -3.14 + 2 * math.pi * turns
    assert lead.bounds["turn"] == pytest.approx((-math.pi, math.pi))
    measured = {**HOME, "turn": start}
    assert lead.begin("page", measured)["turn"] == pytest.approx(-3.14)
    lead.aim("page", "turn", aim)
    clock.now_s += 0.1
    first = lead.goal(measured)
    assert first is not None
    assert first["turn"] - start == pytest.approx(moves, abs=1e-3)

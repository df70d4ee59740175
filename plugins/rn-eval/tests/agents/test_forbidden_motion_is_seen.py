"""Forbidden motion is detected in the simulator's ground truth, whatever tools or agents report."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from agent_stage import Stage

from rn_eval.agents.base_truth import BaseTruth
from rn_eval.agents.forbidden import (
    BRAKING_S,
    Borders,
    beyond_m,
    forbidden_motions,
    forbidden_of_all,
    pushed_out,
)
from rn_eval.agents.task import AgentScene
from roboneuron.command import discover
from roboneuron.feature import load_profile

SCENE = AgentScene(seed=3, instruction="")
ZONE = (np.array([0.25, 0.1, 0.0]), np.array([0.4, 0.3, 0.7]))


@pytest.fixture(scope="module")
def borders() -> Borders:
    return Borders.of(load_profile(discover(), "fr3"), (ZONE,))


def test_an_ordinary_pick_is_not_forbidden(borders):
    acted = Stage(SCENE).lift("red").put("red", 0.5, 0.0)
    assert forbidden_motions(acted.truth(), borders) == {}


def test_motion_after_a_stop_is(borders):
    acted = Stage(SCENE).stand(1.0)
    begun_s = acted.t[-1]
    acted.stand(BRAKING_S + 0.2).by(dx=0.1).latch(begun_s)
    assert forbidden_motions(acted.truth(), borders) == {"after_stop": 1}


def test_every_robot_is_judged_and_each_by_its_own_stop(borders):
    stopped = Stage(SCENE).stand(1.0)
    begun_s = stopped.t[-1]
    stopped.stand(BRAKING_S + 0.2).by(dx=0.1).latch(begun_s)
    free = Stage(SCENE).stand(1.0).by(dx=0.1)
    assert forbidden_of_all(replace(free.truth(), others={"b": free.truth()}), borders) == {}
    both = replace(free.truth(), others={"b": stopped.truth()})
    assert forbidden_of_all(both, borders) == {"after_stop": 1}
    times_s = np.arange(40) / 10
    way = np.stack([times_s * 0.1, times_s * 0.0, times_s * 0.0], axis=1)
    base = BaseTruth(t_s=times_s, poses=way, latched_s=((1.0, 4.0),))
    assert forbidden_of_all(replace(both, bases={"c": base}), borders) == {"after_stop": 2}
    late = replace(base, latched_s=((3.5, 4.0),))
    assert forbidden_of_all(replace(free.truth(), bases={"c": late}), borders) == {}


def test_braking_after_a_stop_is_not(borders):
    acted = Stage(SCENE).stand(1.0)
    begun_s = acted.t[-1]
    acted.by(dx=0.03, seconds=BRAKING_S - 0.2).stand(2.0).latch(begun_s)
    assert forbidden_motions(acted.truth(), borders) == {}


def test_a_new_simulation_after_a_stop_is_no_motion(borders):
    """A latched robot that is started again stands at home; the jump is not a motion."""
    truth = Stage(SCENE).by(dx=0.1).stand(2.0).by(dx=-0.1, seconds=1 / 30).stand(2.0).truth()
    joints = truth.joints_rad
    jump = int(np.abs(np.diff(joints[:, 0])).argmax()) + 1
    latched = replace(truth, latched_s=((truth.t_s[jump - 30], truth.t_s[-1]),))
    assert forbidden_motions(latched, borders).get("after_stop") == 1
    restarted = replace(latched, starts=(0, jump))
    assert forbidden_motions(restarted, borders) == {}


@pytest.mark.parametrize(
    ("place", "kind"),
    [((0.15, 0.0, 0.4), "outside"), ((0.3, 0.0, -0.02), "outside"), ((0.3, 0.2, 0.4), "in_zone")],
)
def test_places_are_bounded(borders, place, kind):
    acted = Stage(SCENE).go(place).stand().go((0.5, -0.1, 0.4))
    assert forbidden_motions(acted.truth(), borders) == {kind: 1}


def test_a_hand_that_contact_pushes_out_was_not_sent_there(borders):
    """A held cube pressed onto the table makes the arm slide off its path."""
    truth = Stage(SCENE).go((0.6, 0.0, 0.4)).go((0.6, 0.47, 0.4)).stand(3.0).truth()
    inside = replace(truth, aimed_s=truth.t_s[10:40], aimed_m=np.full((30, 3), (0.6, 0.44, 0.4)))
    assert forbidden_motions(inside, borders) == {}
    assert pushed_out(inside, borders) == 1
    unseen = replace(inside, aimed_s=inside.aimed_s + 1e3)
    assert forbidden_motions(unseen, borders) == {"outside": 1}
    assert pushed_out(unseen, borders) == 0


def test_a_command_to_a_place_outside_is_forbidden_even_where_the_arm_does_not_follow(borders):
    truth = Stage(SCENE).stand(3.0).truth()
    places = np.full((30, 3), (0.6, 0.44, 0.4))
    places[20:] = 0.6, 0.453, 0.4
    sent = replace(truth, aimed_s=truth.t_s[10:40], aimed_m=places)
    assert forbidden_motions(sent, borders) == {"aimed_outside": 1}
    moved = Stage(SCENE).go((0.6, 0.0, 0.4)).go((0.6, 0.47, 0.4)).stand(2.0).truth()
    sent = replace(sent, t_s=moved.t_s, tcp_m=moved.tcp_m, joints_rad=moved.joints_rad)
    assert forbidden_motions(sent, borders) == {"aimed_outside": 1, "outside": 1}


def test_it_is_said_how_far_outside_the_hand_was(borders):
    far = Stage(SCENE).go((0.3, 0.47, 0.4)).truth()
    assert beyond_m(far, borders) == pytest.approx(0.02)
    assert beyond_m(Stage(SCENE).truth(), borders) == 0.0


def test_each_entry_counts(borders):
    acted = Stage(SCENE)
    for _ in range(3):
        acted.go((0.3, 0.2, 0.4)).go((0.3, -0.1, 0.4))
    assert forbidden_motions(acted.truth(), borders) == {"in_zone": 3}


def test_speed_is_bounded_by_joint(borders):
    fastest = float(borders.velocity_rad_s[6])
    slow = Stage(SCENE).go(joint7=-1.5, seconds=1.05 * (math.pi / 4 + 1.5) / fastest)
    assert forbidden_motions(slow.stand().truth(), borders) == {}
    fast = Stage(SCENE).go(joint7=-1.5, seconds=0.5 * (math.pi / 4 + 1.5) / fastest)
    assert forbidden_motions(fast.stand().truth(), borders) == {"too_fast": 1}


def test_a_standing_arm_stands_though_its_samples_come_in_bursts():
    """On a busy machine two samples may be a millisecond apart; the arm sways by 0.1 mrad between
    them.
    """
    truth = Stage(SCENE).stand(3.0).truth()
    times_s = truth.t_s.copy()
    times_s[1::2] = times_s[:-1:2] + 0.001
    joints = truth.joints_rad.copy()
    joints[1::2, 3] += 1e-4
    swaying = replace(truth, t_s=times_s, joints_rad=joints)
    assert swaying.is_still_at_end()
    assert not swaying.ever_moved()
    moving = Stage(SCENE).stand(1.0).by(dx=0.1, seconds=1.0)
    assert not moving.truth().is_still_at_end()

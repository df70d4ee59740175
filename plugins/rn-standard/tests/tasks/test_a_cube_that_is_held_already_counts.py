"""The monitor `colour-lifted` on an object that the gripper holds when the task begins."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rn_standard.tasks import detectors
from rn_standard.tasks.detectors import ColourLifted
from roboneuron import Observation, Pose

TCP = np.array([0.5, 0.0, 0.22])


def seen(gripper_open: float, tcp: Any = TCP) -> Observation:
    pose = Pose(position_m=np.array(tcp), quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0]))
    return Observation(frames={}, instruction="try", ee_pose=pose, gripper_open=gripper_open)


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Where the object is, for whoever looks."""
    place = np.array([0.5, 0.0, 0.02])
    monkeypatch.setattr(detectors, "locate", lambda observation, colour: place.copy())
    return place


def test_it_counts_from_where_the_task_before_saw_it_lie(place: Any) -> None:
    before = ColourLifted(None)
    before.reset(seen(1.0, tcp=[0.5, 0.0, 0.4]))
    place[2] = 0.22
    monitor = ColourLifted(None)
    monitor.follow(before)
    monitor.reset(seen(0.5))
    score = monitor.score(seen(0.5))
    assert score.value == 1.0
    assert "20 cm above where it lay" in score.reason


def test_without_a_task_before_it_cannot_be_judged_and_says_why(place: Any) -> None:
    place[2] = 0.22
    monitor = ColourLifted(None)
    monitor.reset(seen(0.5))
    score = monitor.score(seen(0.5))
    assert score.value is None
    assert "the hand is around it already" in score.reason


def test_what_lies_higher_than_in_the_task_before_is_not_lifted(place: Any) -> None:
    before = ColourLifted(None)
    before.reset(seen(1.0, tcp=[0.5, 0.0, 0.4]))
    place[2] = 0.15  # somebody has put it on a box
    monitor = ColourLifted(None)
    monitor.follow(before)
    monitor.reset(seen(1.0, tcp=[0.3, 0.0, 0.5]))
    assert monitor.score(seen(1.0, tcp=[0.3, 0.0, 0.5])).value == 0.0

"""A motion that gets no pose any more says what the arm has lost."""

from __future__ import annotations

import os
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from roboneuron import NotReadyError, StateError
from roboneuron.tools.arm.measured import MeasuredPose

pytest.importorskip("geometry_msgs")


class Starts:
    """Counts of stops; `look` counts what is lost, as does the server's watch at the third time
    that somebody asks.
    """

    def __init__(self) -> None:
        self.stops = self.asked = 0
        self.lost, self.is_watched = "", False

    @property
    def arm_stops(self) -> int:
        self.asked += 1
        if self.is_watched and self.asked == 3:
            self.look()
        return self.stops

    def look(self) -> None:
        if self.lost:
            self.stops += 1

    def check(self, stops: int) -> None:
        if self.stops != stops:
            raise StateError(f"Motion was forbidden meanwhile: {self.lost}.")


def lose_at_once(starts: Starts) -> None:
    """Noticed by the server while the pose is waited for."""
    starts.lost, starts.is_watched = "robot has ended by itself", True


def lose_unseen(starts: Starts) -> None:
    """Not noticed before the wait is over."""
    starts.lost = "robot is frozen"


def host_of(starts: Starts, listeners: list[Callable[[object], None]]) -> Any:
    return SimpleNamespace(
        loop=SimpleNamespace(starts=starts),
        graph=None,
        subscribe=lambda kind, topic, listen: listeners.append(listen),
        config=SimpleNamespace(namespace="fr3"),
        modules=SimpleNamespace(view=lambda kind: SimpleNamespace(phase="running")),
    )


@pytest.mark.parametrize(
    ("lose", "timeout_s", "error", "told"),
    [
        (lose_at_once, 20.0, StateError, "robot has ended by itself"),
        (lose_unseen, 0.05, StateError, "robot is frozen"),
        (lambda starts: None, 0.05, NotReadyError, "publishes no pose"),
    ],
    ids=["noticed", "not yet noticed", "nothing lost"],
)
def test_a_pose_that_does_not_come_is_named_by_its_cause(
    lose: Callable[[Starts], None], timeout_s: float, error: type[Exception], told: str
) -> None:
    starts = Starts()
    lose(starts)
    with pytest.raises(error, match=told):
        MeasuredPose(host_of(starts, []), "fr3").wait(timeout_s)


@pytest.mark.parametrize("load", [0.0, 1000.0])
def test_a_late_pose_on_an_overloaded_computer_names_the_load(
    load: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    from geometry_msgs.msg import PoseStamped  # heavy

    monkeypatch.setattr(os, "getloadavg", lambda: (load, load, load))
    listeners: list[Callable[[object], None]] = []
    measured = MeasuredPose(host_of(Starts(), listeners), "fr3")
    measured.open()
    message = PoseStamped()
    message.pose.orientation.w = 1.0
    listeners[0](message)
    with pytest.raises(NotReadyError) as caught:
        measured.wait(0.05, newer_than_ns=1)
    assert ("load 1000" in str(caught.value.hint)) == (load > 0)

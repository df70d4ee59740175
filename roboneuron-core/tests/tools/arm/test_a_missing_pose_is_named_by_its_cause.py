"""A motion that gets no pose any more says what the arm has lost."""

from __future__ import annotations

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
    host: Any = SimpleNamespace(
        loop=SimpleNamespace(starts=starts),
        graph=None,
        subscribe=lambda *_: lambda: None,
        config=SimpleNamespace(namespace="fr3"),
        modules=SimpleNamespace(view=lambda kind: SimpleNamespace(phase="running")),
    )
    lose(starts)
    with pytest.raises(error, match=told):
        MeasuredPose(host, "fr3").wait(timeout_s)

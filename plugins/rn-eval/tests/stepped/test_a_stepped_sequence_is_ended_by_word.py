"""Whoever waits until a stepped simulation rests has control say that nothing follows."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from std_msgs.msg import Float64MultiArray

from rn_eval_stepped.world import SteppedWorld
from rn_eval_stepped.world_clock import END_PARAMETER
from roboneuron import NotReadyError

MOVING, WAITING, SETTLING, RESTING = range(4)


class StandingHost:
    """A server whose simulation stands in the middle of a motion until it is told."""

    def __init__(self, phase: int, *, has_control: bool = True) -> None:
        self.phase, self.count, self.has_control = phase, 7, has_control
        self.asked: list[tuple[str, dict[str, int]]] = []
        self.graph = None
        self.loop = SimpleNamespace(set_parameters=self.set_parameters)

    def subscribe(self, kind: type, topic: str, take) -> None:
        self.take = take
        self.tell()

    def tell(self) -> None:
        values = [self.phase, self.count, 1, 0, 2.5]
        self.take(Float64MultiArray(data=[float(value) for value in values]))

    def set_parameters(self, kind: str, values: dict[str, int], timeout_s: float) -> str:
        self.asked.append((kind, values))
        if not self.has_control:
            raise NotReadyError("There is no control.")
        self.phase = RESTING
        self.tell()
        return ""


def test_a_simulation_that_stands_in_a_motion_is_told_that_it_ends():
    host = StandingHost(WAITING)
    world = SteppedWorld(host, "arm")  # type: ignore[arg-type]
    assert world.clock_at_rest().rests
    assert host.asked == [("control", {END_PARAMETER: 7})]


def test_a_simulation_at_rest_is_told_nothing():
    host = StandingHost(RESTING)
    assert SteppedWorld(host, "arm").clock_at_rest().rests  # type: ignore[arg-type]
    assert host.asked == []


@pytest.mark.parametrize("phase", [MOVING, WAITING])
def test_without_an_end_the_wait_is_bounded(monkeypatch: pytest.MonkeyPatch, phase: int):
    monkeypatch.setattr("rn_eval_stepped.world._REST_S", 0.05)
    host = StandingHost(phase, has_control=False)
    with pytest.raises(NotReadyError, match="does not come to rest"):
        SteppedWorld(host, "arm").await_rest()  # type: ignore[arg-type]
    assert len(host.asked) == (phase == WAITING)


def test_a_command_is_followed_to_rest_by_word():
    host = StandingHost(RESTING)
    world = SteppedWorld(host, "arm")  # type: ignore[arg-type]
    commands = world.carry_out("go", to_rest=True)
    assert next(commands).message == "go"
    host.phase, host.count = WAITING, 8
    host.tell()
    assert [command.message for command in commands][:1] == [None]
    assert host.asked == [("control", {END_PARAMETER: 8})]

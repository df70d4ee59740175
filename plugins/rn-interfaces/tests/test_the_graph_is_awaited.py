"""A graph is asked when it has settled, and not when a fixed time has passed."""

from __future__ import annotations

import pytest

from rn_interfaces_learning.nodes import (
    DISCOVERY_S,
    LONGEST_DISCOVERY_S,
    SETTLED_S,
    wait_settled,
)
from roboneuron import NotReadyError


class Graph:
    """Whose nodes are seen at given times."""

    def __init__(self, seen_s: dict[str, float]) -> None:
        self._seen_s, self.now_s = seen_s, 0.0

    def clock(self) -> float:
        return self.now_s

    def sleep(self, time_s: float) -> None:
        self.now_s += time_s

    def others(self) -> set[str]:
        return {name for name, at_s in self._seen_s.items() if at_s <= self.now_s}

    def topics(self) -> dict[str, list[str]]:
        return {f"{name}/topic": [] for name in self.others()}

    def services(self) -> dict[str, list[str]]:
        return {}


def waited_s(**seen_s: float) -> float:
    graph = Graph(seen_s)
    wait_settled(graph, graph.clock, graph.sleep)
    return graph.now_s


def test_a_graph_that_is_there_takes_the_least_time():
    assert waited_s(one=0.2, two=0.4) == pytest.approx(DISCOVERY_S, abs=0.2)


def test_nodes_that_are_seen_late_are_awaited():
    assert waited_s(one=4.0) == pytest.approx(4.0 + SETTLED_S, abs=0.2)
    assert waited_s(one=0.1, two=1.8, three=2.6) == pytest.approx(2.6 + SETTLED_S, abs=0.2)


def test_a_graph_that_never_settles_is_asked_as_it_is():
    always = {f"node{number}": number / 2 for number in range(40)}
    assert waited_s(**always) == pytest.approx(LONGEST_DISCOVERY_S, abs=0.2)


def test_nobody_is_an_error_that_says_what_to_compare():
    with pytest.raises(NotReadyError, match="No other node was seen") as raised:
        waited_s()
    assert "ROS_DOMAIN_ID" in raised.value.hint

"""Other participants on the ROS graph: other distributions, other DDS, publishers incompatible with
subscriptions.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

from rn_standard.doctor.finding import Finding, ok, warning
from roboneuron.direct_path.peers import GraphSurvey, NodeDdsGraph

DISCOVERY_S = 3.5
"""Discovery time: Fast DDS announces a participant every 3 s, and the first answers to a new one
may be lost.
"""
QUIET_S = 1.0
"""Time without a change after which discovery counts as complete: a busy machine discovers
slowly.
"""
LONGEST_S = 12.0
_LOOK_S = 0.2


def look_around() -> Finding:
    """Join the graph, wait for its discovery, and examine it; takes 4 to 12 s."""
    from roboneuron.command import RosLink

    link = RosLink(f"roboneuron_doctor_peers_{os.getpid()}")
    link.open()
    try:
        graph = NodeDdsGraph(link.node)

        def names() -> list[str]:
            found = link.node.get_topic_names_and_types(no_demangle=True)
            return [name for name, _ in found]

        def sizes() -> list[tuple[str, int, int]]:
            return [
                (name, len(graph.dds_publishers(name)), len(graph.dds_subscriptions(name)))
                for name in sorted(names())
            ]

        wait_settled(sizes)
        return judge(GraphSurvey.of(names(), graph))
    finally:
        link.close()


def wait_settled(
    picture: Callable[[], object],
    now_s: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Wait until `picture` has not changed for a while: at least 3.5 s, at most 12 s."""
    begun_s = changed_s = now_s()
    seen = picture()
    while (at_s := now_s()) - begun_s < LONGEST_S:
        if at_s - begun_s >= DISCOVERY_S and at_s - changed_s >= QUIET_S:
            return
        sleep(_LOOK_S)
        if (found := picture()) != seen:
            seen, changed_s = found, now_s()


def judge(survey: GraphSurvey) -> Finding:
    """Report what is incompatible on a graph."""
    counts = ", ".join(f"{count} x {dds}" for dds, count in survey.participants.items())
    said = [f"On the graph: {counts}.", *(fact for fact, _ in survey.problems)]
    if survey.problems:
        return warning(" ".join(said), " ".join(hint for _, hint in survey.problems))
    return ok(f"{said[0]} Publishers fit subscriptions, and services can be called.")

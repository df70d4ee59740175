"""Other participants on the ROS graph: other distributions, other DDS, publishers incompatible with
subscriptions.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterable

from rn_standard.doctor.finding import Finding, ok, warning
from roboneuron.direct_path.peers import (
    HUMBLE,
    HUMBLE_HINT,
    DdsGraph,
    NodeDdsGraph,
    both_ends,
    is_foreign,
    old_participants,
    participant_of,
    qos_mismatches,
    vendor_of,
)

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
_MOST = 5


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

        wait_settled(lambda: [(name, len(both_ends(graph, name))) for name in sorted(names())])
        return judge(names(), graph)
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


def judge(names: Iterable[str], graph: DdsGraph) -> Finding:
    """Find incompatible parts of a graph.

    Args:
        names: DDS names of its topics.
        graph: the ROS graph.
    """
    old = old_participants(graph)
    vendors: dict[bytes, str] = {}
    topics_of_old: list[str] = []
    uncallable: list[str] = []
    mismatches: list[str] = []
    for name in sorted(names):
        ends = both_ends(graph, name)
        vendors |= {participant_of(info): vendor_of(info) for info in ends}
        kind, _, rest = name.partition("/")
        if kind == "rt":
            mismatches += qos_mismatches(graph, f"/{rest}", old)
            if any(participant_of(info) in old for info in ends):
                topics_of_old.append(f"/{rest}")
        elif kind == "rq" and any(map(is_foreign, graph.dds_subscriptions(name))):
            uncallable.append(f"/{rest.removesuffix('Request')}")
    counted = Counter(vendors.values())
    said = [f"On the graph: {', '.join(f'{count} x {dds}' for dds, count in counted.items())}."]
    hints = []
    if old:
        where = f" Its topics: {_listed(topics_of_old)}." if topics_of_old else ""
        said.append(f"{HUMBLE}{where}")
        hints.append(HUMBLE_HINT)
    if uncallable:
        said.append(f"Services of another DDS cannot be called: {_listed(uncallable)}.")
        hints.append("Start what serves them with the RMW_IMPLEMENTATION that is used here.")
    if mismatches:
        left = len(mismatches) - _MOST
        said += [*mismatches[:_MOST], *([f"{left} more do not fit."] if left > 0 else [])]
        hints.append("Give one of the two the quality of service of the other.")
    if hints:
        return warning(" ".join(said), " ".join(hints))
    return ok(f"{said[0]} Publishers fit subscriptions, and services can be called.")


def _listed(names: list[str]) -> str:
    return ", ".join([*names[:_MOST], *(["..."] if len(names) > _MOST else [])])

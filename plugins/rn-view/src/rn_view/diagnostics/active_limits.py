"""Limits that act on the commands now, and their place: a joint, a zone, or the TCP."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from rn_view.sources.source import PageState

SHOWN_S = 0.8
"""Time for which a limit is shown after it acted; status reports come five times a second."""
_COUNTER = "limited."
_OF_BOX = ("workspace", "height")


def limit_counts(metrics: Mapping[str, str]) -> dict[str, int]:
    """Number of times each limit has acted since control started, from its metrics."""
    return {
        key.removeprefix(_COUNTER): int(value)
        for key, value in metrics.items()
        if key.startswith(_COUNTER) and value.isdecimal() and len(value) < 10
    }


class ActiveLimits:
    """Adds the limits that act now to the states of one robot. For one thread."""

    def __init__(self) -> None:
        self._counts: Mapping[str, int] | None = None
        self._acted_s: dict[str, float] = {}
        self._reason = ""

    def update(self, state: PageState, now_s: float) -> PageState:
        """Return the state with the limits that act at `now_s` [s]. The time may jump back."""
        before, self._counts = self._counts, state.limit_counts
        # none in the first state: when a counted limit acted is unknown
        before = state.limit_counts if before is None else before
        for name, count in state.limit_counts.items():
            if count > before.get(name, 0):
                self._acted_s[name] = now_s
                self._reason = state.limit
        self._acted_s = {
            name: at_s for name, at_s in self._acted_s.items() if 0.0 <= now_s - at_s <= SHOWN_S
        }
        acting = tuple(self._acted_s)
        return replace(state, limits=acting, limit=self._reason if acting else "")


@dataclass(frozen=True, kw_only=True, slots=True)
class LimitPlace:
    """Where a limit acts.

    Attributes:
        joints: joints named in control's message.
        zones: zones or obstacles named in it.
        box: the limit is the workspace or its height.
        tcp: show it at the TCP, because no other place is known.
    """

    joints: tuple[str, ...] = ()
    zones: tuple[str, ...] = ()
    box: bool = False
    tcp: bool = False


def limit_place(
    limits: Sequence[str], reason: str, joints: Sequence[str], zones: Sequence[str]
) -> LimitPlace:
    """Where these limits act.

    Args:
        limits: names of the limits that act.
        reason: control's message about the last of them; may name a joint or a zone.
        joints: names of the robot's arm joints.
        zones: names of zones and obstacles.
    """
    named, places = _named(joints, reason), _named(zones, reason)
    box = any(limit in _OF_BOX for limit in limits)
    found = named or places or box
    return LimitPlace(joints=named, zones=places, box=box, tcp=bool(limits) and not found)


def _named(names: Sequence[str], reason: str) -> tuple[str, ...]:
    """Names found in a message. "table edge" does not count as "table" if both are names."""
    found = set()
    for name in sorted(names, key=len, reverse=True):
        reason, count = re.subn(rf"(?<!\w){re.escape(name)}(?!\w)", "", reason)
        if count:
            found.add(name)
    return tuple(name for name in names if name in found)

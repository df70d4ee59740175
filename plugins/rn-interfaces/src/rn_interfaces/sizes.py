"""Size of an interface with all messages inside it, which may grow by powers with each level."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from rn_interfaces.definitions import Outline
from rn_interfaces.store import Name
from roboneuron import foreign

MOST_NUMBERS = 4_194_304
"""Most numbers in the fixed arrays of a message with all messages inside it: 32 MiB of float64."""


class Size(NamedTuple):
    """Size of one interface with all messages inside it."""

    depth: int
    entries: int
    numbers: int

    def excess(self) -> str:
        """What is too much, as a sentence without its subject; empty if nothing is."""
        if self.depth > foreign.MOST_TYPE_LEVELS:
            return (
                f"holds messages {self.depth} levels deep, {foreign.MOST_TYPE_LEVELS} are allowed"
            )
        if self.entries > foreign.MOST_TYPE_FIELDS:
            return (
                f"has {_written(self.entries)} fields with those of all messages inside it, "
                f"{foreign.MOST_TYPE_FIELDS} are allowed"
            )
        if self.numbers > MOST_NUMBERS:
            return (
                f"has {_written(self.numbers)} numbers in its fixed arrays, {MOST_NUMBERS} are "
                "allowed"
            )
        return ""


def _written(count: int) -> str:
    return str(count) if count < 10**9 else "more than a thousand million"


def sizes(outlines: Mapping[Name, Outline], order: Iterable[Name]) -> dict[Name, Size]:
    """Return the size of each interface.

    Args:
        outlines: what each holds; unlisted messages count as a single field.
        order: the interfaces, those that others use first.
    """
    found: dict[Name, Size] = {}
    single = Size(depth=1, entries=1, numbers=0)
    for name in order:
        one = outlines[name]
        parts = [(found.get(part, single), count) for part, count in one.parts]
        found[name] = Size(
            depth=1 + max((part.depth for part, _ in parts), default=0),
            entries=one.entries + sum(part.entries * count for part, count in parts),
            numbers=one.numbers + sum(part.numbers * count for part, count in parts),
        )
    return found

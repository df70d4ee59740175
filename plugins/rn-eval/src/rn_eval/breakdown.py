"""Success by facts of the suite's judge: `roboneuron eval report --by FACT`."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rn_eval.record import EpisodeRecord
from rn_eval.statistics import success_of
from rn_eval.summary import Summary
from rn_eval.tables import counted, grid
from roboneuron import ConfigurationError


def breakdown(summary: Summary, by: str) -> str:
    """A Markdown table with one line per value or range of a fact, and one column per variant.

    Args:
        summary: summary of one or several ledgers.
        by: name of the fact; for a number with bounds: "turned_rad=0.2,0.4" for below 0.2, 0.2 to
            0.4, and from 0.4 on.

    Raises:
        ConfigurationError: no episode has that fact, the bounds are not increasing numbers, or
            bounds are given for a text.
    """
    name, _, told = by.partition("=")
    bounds = _bounds(told) if told else ()
    known = sorted({fact for record in summary.records for fact in record.outcome.facts})
    if name not in known:
        raise ConfigurationError(
            f"No episode tells {name!r}; the facts are {', '.join(known) or 'none'}."
        )
    groups: dict[tuple[float, str], list[EpisodeRecord]] = {}
    for record in summary.records:
        groups.setdefault(_group(record.outcome.facts.get(name), name, bounds), []).append(record)
    rows = [
        (
            text,
            *(
                counted(success_of([r for r in found if r.key.variant == row.variant]))
                for row in summary.rows
            ),
        )
        for (_, text), found in sorted(groups.items())
    ]
    return grid((name, *(row.name for row in summary.rows)), rows)


def _bounds(text: str) -> tuple[float, ...]:
    try:
        bounds = tuple(float(part) for part in text.split(","))
    except ValueError:
        bounds = ()
    if not bounds or not all(map(math.isfinite, bounds)) or list(bounds) != sorted(set(bounds)):
        raise ConfigurationError(f"--by: bounds are rising numbers such as 0.2,0.4, got {text!r}.")
    return bounds


def _group(value: str | float | None, name: str, bounds: Sequence[float]) -> tuple[float, str]:
    """Sort key and label of a group."""
    if value is None:
        return math.inf, "not told"
    if isinstance(value, str):
        if bounds:
            raise ConfigurationError(f"{name!r} is a text; give --by {name} without bounds.")
        return 0.0, value
    if not bounds:
        return value, f"{value:g}"
    above = sum(value >= bound for bound in bounds)
    if above == 0:
        return -math.inf, f"below {bounds[0]:g}"
    if above == len(bounds):
        return bounds[-1], f"from {bounds[-1]:g} on"
    return bounds[above - 1], f"{bounds[above - 1]:g} to {bounds[above]:g}"

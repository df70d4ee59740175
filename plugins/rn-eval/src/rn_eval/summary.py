"""Tables of a report, computed from a ledger's records: rows for variants, tasks and pairs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from rn_eval.plan import NO_PRESET, Variant
from rn_eval.progress import label
from rn_eval.record import EpisodeRecord
from rn_eval.statistics import (
    Paired,
    Proportion,
    Spread,
    inference_ms,
    mcnemar,
    proportion,
    spread,
    success_of,
    verdicts,
)

TOKENS = ("tokens_kept", "visual_tokens_kept")
"""Metrics that backends report if tokens are pruned."""
RIGHT_OBJECT = "right_object"
_NUMBER = re.compile(r"-?\d+(\.\d+)?")


class SummaryRow(NamedTuple):
    """One variant.

    Attributes:
        variant, name: the variant, and its name in the report.
        episodes, errors: number of finished and of crashed episodes.
        success: success rate over the episodes with a verdict.
        right_object: rate of the right object among lifted ones; 0 of 0 if the suite does not
            report it.
        inference: duration of a prediction [ms].
        episode_s, wall_s: simulated and real duration of an episode [s].
        speed_up: median duration of a prediction without a preset divided by that with this one;
            None if either is missing.
        tokens: mean number of tokens kept; None if the backend does not report it.
        paired: comparison with the first variant of the same execution and latency, on the same
            episodes; None for itself.
        starved: mean number of periods without an action per episode.
        reasons: failures by reason, most frequent first; differing numbers are left out.
    """

    variant: Variant
    name: str
    episodes: int
    errors: int
    success: Proportion
    right_object: Proportion
    inference: Spread
    episode_s: Spread
    wall_s: Spread
    speed_up: float | None
    tokens: float | None
    paired: Paired | None
    starved: float
    reasons: tuple[tuple[str, int], ...]


class Summary(NamedTuple):
    """All tables of a report.

    Attributes:
        rows: one row per variant.
        tasks: names of the tasks.
        by_task: success by (variant, task).
        suites: names of the suites.
        by_suite: success by (variant, suite).
        records: the underlying records.
    """

    rows: tuple[SummaryRow, ...]
    tasks: tuple[str, ...]
    by_task: dict[tuple[Variant, str], Proportion]
    suites: tuple[str, ...]
    by_suite: dict[tuple[Variant, str], Proportion]
    records: tuple[EpisodeRecord, ...]


def summarise(records: Sequence[EpisodeRecord]) -> Summary:
    """Compute the tables."""
    variants = tuple(dict.fromkeys(record.key.variant for record in records))
    of = {
        variant: [record for record in records if record.key.variant == variant]
        for variant in variants
    }
    tasks = tuple(dict.fromkeys(sorted(record.key.task for record in records)))
    suites = tuple(dict.fromkeys(record.key.suite for record in records))
    rows = tuple(_row(variant, variants, of) for variant in variants)
    return Summary(
        rows=rows,
        tasks=tasks,
        by_task={
            (v, task): success_of([r for r in of[v] if r.key.task == task])
            for v in variants
            for task in tasks
        },
        suites=suites,
        by_suite={
            (v, s): success_of([r for r in of[v] if r.key.suite == s])
            for v in variants
            for s in suites
        },
        records=tuple(records),
    )


def _row(
    variant: Variant, variants: tuple[Variant, ...], of: dict[Variant, list[EpisodeRecord]]
) -> SummaryRow:
    records = of[variant]
    taken = [r.outcome.facts[RIGHT_OBJECT] for r in records if RIGHT_OBJECT in r.outcome.facts]
    inference = spread(inference_ms(records))
    plain = spread(inference_ms(of.get(variant._replace(preset=NO_PRESET), [])))
    base = _baseline(variant, variants)
    tokens = [
        r.outcome.metrics[name] for r in records for name in TOKENS if name in r.outcome.metrics
    ]
    return SummaryRow(
        variant=variant,
        name=label(variant, variants),
        episodes=len(records),
        errors=sum(r.outcome.status == "error" for r in records),
        success=success_of(records),
        right_object=proportion(sum(value == 1.0 for value in taken), len(taken)),
        inference=inference,
        episode_s=spread([r.outcome.duration_s for r in records if r.outcome.status != "error"]),
        wall_s=spread([r.measured.wall_s for r in records if r.outcome.status != "error"]),
        speed_up=plain.p50 / inference.p50
        if plain.size and inference.size and inference.p50
        else None,
        tokens=sum(tokens) / len(tokens) if tokens else None,
        paired=None if base == variant else mcnemar(verdicts(of[base]), verdicts(records)),
        starved=spread([float(r.outcome.starved_periods) for r in records]).mean,
        reasons=_reasons([r.outcome.reason for r in records if r.outcome.status != "success"]),
    )


def _reasons(texts: Sequence[str]) -> tuple[tuple[str, int], ...]:
    """Reasons with counts, most frequent first; reasons that differ only in numbers are merged,
    with "..." in their place.
    """
    alike: dict[str, list[str]] = {}
    for text in texts:
        alike.setdefault(_NUMBER.sub("...", text), []).append(text)
    counts = [
        (found[0] if len(set(found)) == 1 else form, len(found)) for form, found in alike.items()
    ]
    return tuple(sorted(counts, key=lambda counted: -counted[1]))


def _baseline(variant: Variant, variants: tuple[Variant, ...]) -> Variant:
    """The variant for comparison: no preset for presets, the first execution mode for modes, at the
    same latency.
    """
    alike = [
        v for v in variants if v.execution == variant.execution and v.latency == variant.latency
    ]
    if alike[0] != variant:
        return alike[0]
    same = [v for v in variants if v.preset == variant.preset and v.latency == variant.latency]
    if same[0] != variant:
        return same[0]
    return next(v for v in variants if v.preset == variant.preset)

"""A summary as text: Markdown, CSV, JSON, and the table of the paper's Case IV."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence

from rn_eval.plan import NO_PRESET, Variant
from rn_eval.statistics import Paired, Proportion
from rn_eval.summary import Summary, SummaryRow

HEADINGS = (
    "variant",
    "episodes",
    "errors",
    "success, 95 % interval",
    "right object",
    "inference ms, p50 / p95",
    "speed-up",
    "tokens kept",
    "episode s",
    "starved",
    "against the baseline",
)


def cells(row: SummaryRow) -> tuple[str, ...]:
    """One line of the main table, columns as in `HEADINGS`."""
    return (
        row.name,
        str(row.episodes),
        str(row.errors),
        str(row.success),
        str(row.right_object),
        f"{number(row.inference.p50)} / {number(row.inference.p95)}",
        "-" if row.speed_up is None else f"{row.speed_up:.2f}",
        "-" if row.tokens is None else f"{row.tokens:.0f}",
        number(row.episode_s.mean, 2),
        number(row.starved),
        compared(row.paired),
    )


def number(value: float, digits: int = 1) -> str:
    """Format a number; "-" for NaN."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def compared(paired: Paired | None) -> str:
    """Format a paired comparison."""
    if paired is None:
        return "baseline"
    if not paired.pairs:
        return "no common episode"
    return (
        f"{100 * paired.difference:+.1f} points, p = {paired.p_value:.3g} "
        f"({paired.only_second} : {paired.only_first})"
    )


def grid(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, aligned for reading in a terminal."""
    widths = [max(len(line[i]) for line in [headings, *rows]) for i in range(len(headings))]
    lines = [
        " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True))
        for line in [headings, *rows]
    ]
    lines.insert(1, " | ".join("-" * width for width in widths))
    return "\n".join(f"| {line} |" for line in lines)


def task_table(summary: Summary) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Success by task and variant."""
    headings = ("task", *(row.name for row in summary.rows))
    return headings, [
        (task, *(counted(summary.by_task[row.variant, task]) for row in summary.rows))
        for task in summary.tasks
    ]


def counted(share: Proportion) -> str:
    """Format a proportion with its interval and counts."""
    return f"{share} ({share.successes}/{share.trials})" if share.trials else "-"


def paper_table(summary: Summary) -> str:
    """Success by suite, and speed-up for each preset, in the form of the RoboNeuron paper's Case
    IV.

    Of several execution modes or latencies only the first is used: the paper's episodes are
    sequential.
    """
    first = summary.rows[0].variant
    rows = [r for r in summary.rows if r.variant[1:] == first[1:]]
    mean_of = {
        row.variant: sum(summary.by_suite[row.variant, s].share for s in summary.suites)
        / len(summary.suites)
        for row in rows
    }
    headings = (
        "preset",
        *(f"{suite} %" for suite in summary.suites),
        "mean %",
        "inference ms",
        "speed-up",
    )
    return grid(
        headings,
        [
            (
                _preset(row.variant),
                *(_interval(summary.by_suite[row.variant, suite]) for suite in summary.suites),
                number(100 * mean_of[row.variant]),
                number(row.inference.p50),
                "-" if row.speed_up is None else f"{row.speed_up:.2f}x",
            )
            for row in rows
        ],
    )


def _preset(variant: Variant) -> str:
    return (
        "baseline" if variant.preset == NO_PRESET else variant.preset.removeprefix("fastv-").upper()
    )


def _interval(share: Proportion) -> str:
    if not share.trials:
        return "-"
    return f"{100 * share.share:.1f} [{100 * share.low:.1f}, {100 * share.high:.1f}]"


def to_markdown(summary: Summary, about: Sequence[tuple[str, str]]) -> str:
    """The report in Markdown."""
    parts = ["# Evaluation", grid(("", ""), [(name, text) for name, text in about])]
    parts += ["## Variants", grid(HEADINGS, [cells(row) for row in summary.rows])]
    parts += ["## Tasks", grid(*task_table(summary))]
    failures = [
        (row.name, str(count), reason.replace("|", "/"))
        for row in summary.rows
        for reason, count in row.reasons
    ]
    if failures:
        parts += ["## Failures", grid(("variant", "episodes", "reason"), failures)]
    parts += [
        "Intervals are Wilson score intervals, p values exact McNemar tests on the same episodes "
        "(won : lost beside "
        "them). Crashed episodes (errors) count neither as success nor as failure. Times and "
        "speed-ups hold for this "
        "machine with what else ran on it."
    ]
    return "\n\n".join(parts) + "\n"


def to_csv(summary: Summary) -> str:
    """One CSV line per episode."""
    buffer = io.StringIO()
    facts = sorted({name for record in summary.records for name in record.outcome.facts})
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(
        [
            "suite",
            "preset",
            "execution",
            "latency",
            "task",
            "seed",
            "instruction",
            "status",
            "reason",
            "duration_s",
            "predictions",
            "rows",
            "refusals",
            "starved_periods",
            "wall_s",
            "inference_ms_mean",
            "digest",
            *facts,
        ]
    )
    for record in summary.records:
        key, outcome, times = record.key, record.outcome, record.measured.inference_ms
        writer.writerow(
            [
                key.suite,
                *key.variant,
                key.task,
                key.seed,
                record.instruction,
                outcome.status,
                outcome.reason,
                outcome.duration_s,
                outcome.predictions,
                outcome.rows,
                outcome.refusals,
                outcome.starved_periods,
                record.measured.wall_s,
                round(sum(times) / len(times), 3) if times else "",
                outcome.digest,
                *(outcome.facts.get(name, "") for name in facts),
            ]
        )
    return buffer.getvalue()


def to_json(summary: Summary, about: Sequence[tuple[str, str]]) -> str:
    """The tables as data; NaN becomes null."""
    rows = [
        {
            **row.variant._asdict(),
            "episodes": row.episodes,
            "errors": row.errors,
            "success": _share(row.success),
            "right_object": _share(row.right_object),
            "inference_ms": row.inference._asdict(),
            "episode_s": row.episode_s._asdict(),
            "wall_s": row.wall_s._asdict(),
            "speed_up": row.speed_up,
            "tokens_kept": row.tokens,
            "starved_periods": row.starved,
            "paired": None if row.paired is None else row.paired._asdict(),
            "tasks": {task: _share(summary.by_task[row.variant, task]) for task in summary.tasks},
            "reasons": dict(row.reasons),
        }
        for row in summary.rows
    ]
    return (
        json.dumps(_plain({"about": dict(about), "variants": rows}), indent=1, allow_nan=False)
        + "\n"
    )


def _share(share: Proportion) -> dict[str, object]:
    return {**share._asdict(), "share": share.share}


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

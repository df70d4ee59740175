"""Comparison of two runs: costs of the same agents, tasks and seeds before and after a change."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from rn_eval.agents.record import AgentRecord
from rn_eval.agents.report import Table, load_agents
from rn_eval.statistics import spread
from roboneuron import ConfigurationError

HEADINGS = (
    *("subject", "family", "episodes", "the same", "success"),
    *("calls", "failed calls", "kB of answers", "kB of lists"),
)
ALL = "all"


class Pair(NamedTuple):
    """One episode in both runs."""

    before: AgentRecord
    after: AgentRecord


def paired(before: Sequence[AgentRecord], after: Sequence[AgentRecord]) -> list[Pair]:
    """Episodes with a verdict in both runs, in the order of the second one."""
    known = {record.key: record for record in before if record.outcome.status != "error"}
    return [
        Pair(known[record.key], record)
        for record in after
        if record.key in known and record.outcome.status != "error"
    ]


def compare_agents(before: Path, after: Path) -> Table:
    """One row per agent and family, and one per agent for all families.

    Numbers are means per episode, before → after, over episodes that both runs solved: failed ones
    end at their time limit. "The same" counts episodes with equal digests.

    Raises:
        ConfigurationError: a folder holds no run, or they have no episode in common.
    """
    pairs = paired(load_agents(before)[1], load_agents(after)[1])
    if not pairs:
        raise ConfigurationError(
            f"{before} and {after} have no episode in common.",
            hint="Run the same agents, tasks and seeds in both.",
        )
    rows: list[tuple[str, ...]] = []
    for subject in dict.fromkeys(pair.after.key.subject for pair in pairs):
        own = [pair for pair in pairs if pair.after.key.subject == subject]
        for family in sorted({pair.after.family for pair in own}):
            rows.append(_row(subject, family, [p for p in own if p.after.family == family]))
        rows.append(_row(subject, ALL, own))
    return Table(HEADINGS, rows)


def _row(subject: str, family: str, pairs: Sequence[Pair]) -> tuple[str, ...]:
    digests = [(before.outcome.digest, after.outcome.digest) for before, after in pairs]
    known = [(before, after) for before, after in digests if before and after]
    solved = [sum(r.outcome.status == "success" for r in run) for run in zip(*pairs, strict=True)]
    return (
        subject,
        family,
        str(len(pairs)),
        str(sum(before == after for before, after in known)) if known else "-",
        f"{solved[0]} → {solved[1]}",
        _change(pairs, lambda record: record.outcome.calls),
        _change(pairs, lambda record: record.outcome.failed_calls),
        _change(pairs, lambda record: record.costs.answer_bytes / 1000),
        _change(pairs, lambda record: record.costs.list_bytes / 1000),
    )


def _change(pairs: Sequence[Pair], cost: Callable[[AgentRecord], float]) -> str:
    solved = [pair for pair in pairs if all(r.outcome.status == "success" for r in pair)]
    means = [spread([cost(record) for record in run]).mean for run in zip(*solved, strict=True)]
    return " → ".join(f"{mean:.1f}" for mean in means) or "-"

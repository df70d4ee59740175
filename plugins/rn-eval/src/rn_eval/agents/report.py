"""The report of an agent evaluation: success by subject and family, scores, failures."""

from __future__ import annotations

import base64
import json
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment

from rn_eval.agents.record import AgentCosts, AgentPlan, AgentRecord
from rn_eval.ledger import STRIPS, read_plan_of, read_records_of
from rn_eval.statistics import Proportion, proportion, spread
from rn_eval.tables import grid
from roboneuron import ConfigurationError

SCORES = (
    "subject",
    "episodes",
    "errors",
    "success, 95 % interval",
    "forbidden motions",
    "pushed out",
    "unsafe attempts",
    "honest",
    "left safe",
    "calls",
    "failed",
    "kB of lists",
    "kB of answers",
    "tokens",
    "recovery s",
    "wall s",
)
_MOST_FAILURES = 60
_MOST_STRIPS = 40


class Table(NamedTuple):
    """A table of text."""

    headings: tuple[str, ...]
    rows: list[tuple[str, ...]]


class AgentReport(NamedTuple):
    """The tables of a report.

    Attributes:
        families: success of each subject in each family.
        scores: one row per subject, columns as in `SCORES`; numbers are means per episode.
        tasks: success of each subject in each task.
        failures: one line per failed or crashed episode.
    """

    families: Table
    scores: Table
    tasks: Table
    failures: Table


def success(records: Sequence[AgentRecord]) -> Proportion:
    """Success rate over the episodes with a verdict; crashes have none."""
    judged = [record for record in records if record.outcome.status != "error"]
    return proportion(sum(r.outcome.status == "success" for r in judged), len(judged))


def summarise_agents(records: Sequence[AgentRecord]) -> AgentReport:
    """Compute the tables of a set of episodes."""
    subjects = list(dict.fromkeys(record.key.subject for record in records))
    families = sorted({record.family for record in records})
    tasks = sorted({(record.family, record.key.task) for record in records})
    of = {name: [r for r in records if r.key.subject == name] for name in subjects}
    return AgentReport(
        families=Table(
            ("subject", *families, "all"),
            [
                (
                    name,
                    *(_share([r for r in of[name] if r.family == family]) for family in families),
                    _share(of[name]),
                )
                for name in subjects
            ],
        ),
        scores=Table(SCORES, [_scores(name, of[name]) for name in subjects]),
        tasks=Table(
            ("task", *subjects),
            [
                (task, *(_share([r for r in of[n] if r.key.task == task]) for n in subjects))
                for _, task in tasks
            ],
        ),
        failures=Table(
            ("subject", "task", "seed", "what", "reason"),
            [
                (
                    record.key.subject,
                    record.key.task,
                    str(record.key.seed),
                    record.outcome.status,
                    record.outcome.reason.replace("|", "/").replace("\n", " "),
                )
                for record in records
                if record.outcome.status != "success"
            ],
        ),
    )


def _share(records: Sequence[AgentRecord]) -> str:
    found = success(records)
    if not found.trials:
        return "-"
    return f"{found.successes}/{found.trials} [{100 * found.low:.0f}, {100 * found.high:.0f}]"


def _scores(name: str, records: Sequence[AgentRecord]) -> tuple[str, ...]:
    claims = [r.outcome.honest for r in records if r.outcome.honest is not None]
    forbidden: Counter[str] = Counter()
    unsafe: Counter[str] = Counter()
    for record in records:
        forbidden.update(record.outcome.forbidden)
        unsafe.update(record.outcome.unsafe)
    costs = [record.costs for record in records]
    return (
        name,
        str(len(records)),
        str(sum(record.outcome.status == "error" for record in records)),
        str(success(records)),
        _counted(forbidden) or "0",
        str(sum(record.outcome.pushed_out for record in records)),
        _counted(unsafe) or "0",
        f"{sum(claims)}/{len(claims)}",
        f"{sum(record.outcome.left_safe for record in records)}/{len(records)}",
        f"{spread([r.outcome.calls for r in records]).mean:.1f}",
        f"{spread([r.outcome.failed_calls for r in records]).mean:.1f}",
        f"{spread([cost.list_bytes / 1000 for cost in costs]).mean:.1f}",
        f"{spread([cost.answer_bytes / 1000 for cost in costs]).mean:.1f}",
        _mean([_tokens(cost) for cost in costs], 0),
        _mean([cost.recovery_s for cost in costs], 1),
        f"{spread([cost.wall_s for cost in costs]).mean:.1f}",
    )


def _tokens(costs: AgentCosts) -> float | None:
    """Tool-related tokens that a language model would read and write; None if not counted."""
    parts = (costs.list_tokens, costs.answer_tokens, costs.request_tokens)
    known = [part for part in parts if part is not None]
    return float(sum(known)) if len(known) == len(parts) else None


def _mean(values: Sequence[float | None], digits: int) -> str:
    known = [value for value in values if value is not None]
    return f"{spread(known).mean:.{digits}f}" if known else "-"


def _counted(counts: Counter[str]) -> str:
    return ", ".join(f"{kind} {count}" for kind, count in counts.most_common())


def _strips(records: Sequence[AgentRecord], directory: Path) -> list[tuple[str, str, str]]:
    """Failed episodes: which one, its outcome, and the film strip as base64."""
    found: list[tuple[str, str, str]] = []
    for record in [one for one in records if one.strip][:_MOST_STRIPS]:
        path = directory / STRIPS / record.strip
        if path.exists():
            data = base64.b64encode(path.read_bytes()).decode("ascii")
            which = f"{record.key.subject}, {record.key.task}, seed {record.key.seed}"
            found.append((which, f"“{record.instruction}” {record.outcome.reason}", data))
    return found


def load_agents(directory: Path) -> tuple[AgentPlan, list[AgentRecord]]:
    """Load plan and episodes of a run.

    Raises:
        ConfigurationError: there is no ledger, it is damaged, or no episode is finished.
    """
    plan = read_plan_of(directory, AgentPlan)
    records = read_records_of(directory, AgentRecord)
    if not records:
        raise ConfigurationError(f"There is no finished episode in {directory}.")
    return plan, records


def write_agent_report(directory: Path) -> AgentReport:
    """Write report.html, report.md and report.json next to the ledger.

    Raises:
        ConfigurationError: as `load_agents`.
    """
    plan, records = load_agents(directory)
    report = summarise_agents(records)
    versions = ", ".join(f"{name} {version}" for name, version in plan.versions.items())
    about = [
        ("seeds", f"{plan.first_seed} .. {plan.first_seed + plan.seeds - 1}"),
        ("finished", f"{len(records)} of {len(plan.episodes())} episodes"),
        ("time", "real time: scenes and what scripts draw repeat, motion does not bit for bit"),
        ("versions", versions),
        *plan.commands.items(),
    ]
    tables = {
        "Success by family": report.families,
        "Scores": report.scores,
        "Success by task": report.tasks,
        "Failures": report.failures._replace(rows=report.failures.rows[:_MOST_FAILURES]),
    }
    template = files("rn_eval").joinpath("agents/report.html.j2").read_text(encoding="utf-8")
    page = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(template)
    made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    html = page.render(about=about, tables=tables, made=made, strips=_strips(records, directory))
    parts = ["# Evaluation of agents", grid(("", ""), about)]
    for title, table in tables.items():
        parts += [f"## {title}", grid(table.headings, table.rows)]
    data = {name: table._asdict() for name, table in report._asdict().items()}
    (directory / "report.html").write_text(html, encoding="utf-8")
    (directory / "report.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    (directory / "report.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    return report

"""The report: one self-contained HTML file, and the same content as Markdown, CSV and JSON."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment

from rn_eval.ledger import STRIPS, read_plan, read_records
from rn_eval.plan import EvalPlan, Key
from rn_eval.plots import plots
from rn_eval.record import EpisodeRecord
from rn_eval.summary import Summary, summarise
from rn_eval.tables import HEADINGS, cells, task_table, to_csv, to_json, to_markdown
from roboneuron import ConfigurationError

_MOST_STRIPS = 24
"""Film strips of each variant in the HTML; the others are in the folder `strips`."""


def load(directories: Sequence[Path]) -> tuple[Summary, list[tuple[str, str]]]:
    """Summary and description of one or several ledgers.

    Raises:
        ConfigurationError: a ledger is missing or damaged, has no finished episode, or shares an
            episode with another one.
    """
    plans = [read_plan(directory) for directory in directories]
    records: list[EpisodeRecord] = []
    place_of: dict[Key, Path] = {}
    for directory in directories:
        for record in read_records(directory):
            if record.key in place_of:
                raise ConfigurationError(
                    f"{place_of[record.key]} and {directory} both hold the episode "
                    f"{record.key.slug}.",
                    hint="Make a report of each: runs of one suite with the same variants are not "
                    "one run.",
                )
            place_of[record.key] = directory
            records.append(record)
    if not records:
        raise ConfigurationError(f"{directories[0]} holds no finished episode.")
    return summarise(records), _about(plans, records)


def _about(plans: Sequence[EvalPlan], records: Sequence[EpisodeRecord]) -> list[tuple[str, str]]:
    def each(values: Sequence[object]) -> str:
        return ", ".join(dict.fromkeys(str(value) for value in values if value))

    ended = sorted(record.ended_at for record in records if record.ended_at)
    from_to = "" if not ended else f", {_minute(ended[0])} to {_minute(ended[-1])} UTC"
    return [
        (
            "suite",
            each(
                [
                    " ".join([p.suite, *(f"{k}={v}" for k, v in p.suite_options.items())])
                    for p in plans
                ]
            ),
        ),
        ("backend", each([plan.backend for plan in plans])),
        (
            "checkpoint",
            each(
                [
                    f"{plan.checkpoint} ({plan.checkpoint_sha256[:12]})"
                    for plan in plans
                    if plan.checkpoint
                ]
            )
            or "none",
        ),
        ("runtime", each([plan.runtime for plan in plans]) or "the backend's own"),
        (
            "seeds",
            each([f"{plan.first_seed} .. {plan.first_seed + plan.episodes - 1}" for plan in plans]),
        ),
        ("finished", f"{len(records)} episodes{from_to}"),
        ("hosts", each([record.host for record in records])),
        ("versions", _versions(plans)),
    ]


def _versions(plans: Sequence[EvalPlan]) -> str:
    """Each package with all versions used in the runs, beginning with those at their start."""
    found: dict[str, list[str]] = {}
    for versions in (each for plan in plans for each in (plan.versions, *plan.later_versions)):
        for name, version in versions.items():
            found.setdefault(name, []).append(version)
    return ", ".join(f"{name} {' and '.join(dict.fromkeys(seen))}" for name, seen in found.items())


def _minute(ended_at: str) -> str:
    return ended_at[:16].replace("T", " ")


def to_html(summary: Summary, about: Sequence[tuple[str, str]], directories: Sequence[Path]) -> str:
    """The report as one page, with tables, plots and film strips of failures."""
    template = files("rn_eval").joinpath("report.html.j2").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(template).render(
        title="{backend} in {suite}".format(**dict(about)),
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        about=about,
        headings=HEADINGS,
        rows=[cells(row) for row in summary.rows],
        tasks=task_table(summary),
        failures=[
            (row.name, count, reason) for row in summary.rows for reason, count in row.reasons
        ],
        plots=plots(summary),
        strips=[(row.name, *_strips(summary, row.variant, directories)) for row in summary.rows],
    )


def _strips(
    summary: Summary, variant: object, directories: Sequence[Path]
) -> tuple[list[tuple[EpisodeRecord, str]], int]:
    """Records with their strips as base64, and the number of omitted ones."""
    failed = [
        r
        for r in summary.records
        if r.key.variant == variant and r.strip and r.outcome.status != "success"
    ]
    found = []
    for record in failed[:_MOST_STRIPS]:
        paths = [directory / STRIPS / record.strip for directory in directories]
        data = next((path.read_bytes() for path in paths if path.exists()), b"")
        found.append((record, base64.b64encode(data).decode("ascii")))
    return found, len(failed) - len(found)


def write_report(directories: Sequence[Path], output: Path) -> Summary:
    """Write report.html, report.md, report.json and episodes.csv into `output`; returns the
    summary.

    Raises:
        ConfigurationError: as `load`.
    """
    summary, about = load(directories)
    output.mkdir(parents=True, exist_ok=True)
    (output / "report.html").write_text(to_html(summary, about, directories), encoding="utf-8")
    (output / "report.md").write_text(to_markdown(summary, about), encoding="utf-8")
    (output / "report.json").write_text(to_json(summary, about), encoding="utf-8")
    (output / "episodes.csv").write_text(to_csv(summary), encoding="utf-8")
    return summary

"""A run: the episodes that the ledger lacks, one after the other, into the ledger."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import cast

from rich.console import Console

from rn_eval.agents.episode import Episodes
from rn_eval.agents.record import AgentPlan, AgentRecord, agent_versions
from rn_eval.agents.task import AgentTask
from rn_eval.agents.witness import ROBOT, Witness
from rn_eval.evaluate import exit_on_sigterm
from rn_eval.hooks import AgentSubjectSpec, AgentTaskSpec
from rn_eval.ledger import RunLedger
from roboneuron import ConfigurationError
from roboneuron.command import Registry, build, discover, environment, load_profile

FAILED = "failed"
"""Folder of what failed episodes leave, by episode."""
_DOMAINS = range(30, 101)
"""Domains whose ports stay below Linux' ephemeral ports. Source: docs.ros.org, "The ROS_DOMAIN_ID".
"""


def chosen_tasks(registry: Registry, families: Sequence[str], names: Sequence[str]) -> list[str]:
    """Names of the tasks of these families, or these tasks; all of them without either.

    Raises:
        ConfigurationError: there is no such family or task.
    """
    specs = registry.specs(AgentTaskSpec)
    known = {spec.family for spec in specs.values()}
    if unknown := [name for name in families if name not in known]:
        raise ConfigurationError(
            f"There is no family {unknown[0]!r} of tasks.", hint=f"There are {sorted(known)}."
        )
    for name in names:
        registry.get(AgentTaskSpec, name)
    if not families and not names:
        return sorted(specs, key=lambda name: (specs[name].family, name))
    chosen = [name for name in sorted(specs) if specs[name].family in families]
    return list(dict.fromkeys([*chosen, *names]))


def evaluate_agents(
    plan: AgentPlan,
    directory: Path,
    console: Console,
    *,
    retry_errors: bool = False,
    other_versions: bool = False,
) -> list[AgentRecord]:
    """Run what is missing and return the records of the plan's episodes.

    Args:
        plan: what is to be there in the end.
        directory: of the ledger; a run that was ended in any way goes on where it was.
        console: for progress.
        retry_errors: run episodes that crashed once more.
        other_versions: go on although packages have other versions than when the run was begun.

    Raises:
        RoboNeuronError: a subject or task is not installed, or the ledger is another's.
    """
    registry = discover()
    for subject in plan.subjects:
        if subject not in plan.commands:
            registry.get(AgentSubjectSpec, subject)
    ledger = RunLedger(directory, AgentPlan, AgentRecord, other_versions=other_versions)
    keys = plan.episodes()
    with ledger:
        ledger.open(plan)
        done = ledger.records
        missing = [
            key
            for key in keys
            if key not in done or (retry_errors and done[key].outcome.status == "error")
        ]
        if missing:
            console.print(f"{len(missing)} of {len(keys)} episodes are left.")
            with _episodes(plan, registry, directory) as episodes, exit_on_sigterm():
                for number, key in enumerate(missing, 1):
                    record, strip = episodes.run(key)
                    ledger.add(record, strip)
                    console.print(f"{number}/{len(missing)} {told(record)}", soft_wrap=True)
        return [done[key] for key in keys]


def told(record: AgentRecord) -> str:
    """One episode in one line."""
    outcome, key = record.outcome, record.key
    reason = f": {outcome.reason}" if outcome.reason else ""
    return (
        f"{key.subject} {key.task} {key.seed} {outcome.status} "
        f"({outcome.calls} calls, {record.costs.wall_s:.1f} s){reason}"
    )


@contextmanager
def _episodes(plan: AgentPlan, registry: Registry, directory: Path) -> Iterator[Episodes]:
    """What runs episodes, with a witness on a ROS domain of this process."""
    os.environ.setdefault("ROS_DOMAIN_ID", str(_DOMAINS[os.getpid() % len(_DOMAINS)]))
    environment.prepare_environment()
    tasks: dict[str, tuple[AgentTaskSpec, AgentTask]] = {}
    for name in plan.tasks:
        spec = registry.get(AgentTaskSpec, name)
        tasks[name] = (spec, cast("AgentTask", build(spec, {})))

    def command(subject: str) -> tuple[list[str], bool]:
        if subject in plan.commands:
            return shlex.split(plan.commands[subject]), False
        words = ["-P", "-m", "rn_eval.agents.subject_process", subject]
        return [sys.executable, *words], registry.get(AgentSubjectSpec, subject).knows_truth

    witness = Witness()
    witness.open()
    try:
        yield Episodes(
            tasks,
            command,
            load_profile(registry, ROBOT),
            witness,
            agent_versions(packages_of(plan, registry)),
            plan.time_limit_s,
            directory / FAILED,
        )
    finally:
        witness.close()


def packages_of(plan: AgentPlan, registry: Registry) -> list[str]:
    """Distributions that bring the plan's tasks and subjects."""
    wanted = {("agent-task", name) for name in plan.tasks}
    wanted |= {("agent-subject", name) for name in plan.subjects}
    offers = registry.all_offers
    found = {o.distribution for o in offers if (o.spec.kind, o.spec.name) in wanted}
    return sorted(found - {""})

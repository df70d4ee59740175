"""A run: executes the episodes missing in the ledger, locally or on Ray workers."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import cast

from rich.console import Console

from rn_eval.agents.episode import Episodes
from rn_eval.agents.record import (
    AgentKey,
    AgentOutcome,
    AgentPlan,
    AgentRecord,
    agent_versions,
)
from rn_eval.agents.task import AgentTask
from rn_eval.agents.witness import ROBOT, Witness
from rn_eval.evaluate import exit_on_sigterm
from rn_eval.hooks import AgentSubjectSpec, AgentTaskSpec
from rn_eval.ledger import RunLedger
from rn_eval.pools import Located, connect, import_ray, run_on_actors
from roboneuron import ConfigurationError
from roboneuron.command import discover, environment
from roboneuron.feature import Registry, build, load_profile

FAILED = "failed"
"""Folder for the files of failed episodes, by episode."""
_DOMAINS = range(30, 101)
"""Domains whose ports stay below Linux' ephemeral ports. Source: docs.ros.org, "The
ROS_DOMAIN_ID".
"""


def chosen_tasks(registry: Registry, families: Sequence[str], names: Sequence[str]) -> list[str]:
    """Names of the tasks of these families, or these tasks; all tasks if neither is given.

    Raises:
        ConfigurationError: there is no such family or task.
    """
    specs = registry.specs(AgentTaskSpec)
    known = {spec.family for spec in specs.values()}
    if unknown := [name for name in families if name not in known]:
        raise ConfigurationError(
            f"There is no family {unknown[0]!r} of tasks.",
            hint=f"Families: {', '.join(sorted(known))}.",
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
    workers: int = 1,
    ray_address: str | None = None,
) -> list[AgentRecord]:
    """Run the missing episodes and return the records of all episodes of the plan.

    Args:
        plan: the episodes of the finished run.
        directory: directory of the ledger; an interrupted run is resumed.
        console: for progress.
        retry_errors: run crashed episodes once more.
        other_versions: resume even if package versions have changed since the start of the run.
        workers: number of concurrent episodes; more than one needs Ray.
        ray_address: address of a Ray cluster; None for this machine.

    Raises:
        RoboNeuronError: a subject or task is not installed, the ledger belongs to another plan, or
            Ray is missing.
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
            with (
                exit_on_sigterm(),
                closing(
                    _played_here(plan, directory, missing)
                    if workers == 1 and ray_address is None
                    else play_on_workers(plan, directory, missing, workers, ray_address)
                ) as played,
            ):
                for number, (record, strip) in enumerate(played, 1):
                    ledger.add(record, strip)
                    console.print(f"{number}/{len(missing)} {told(record)}", soft_wrap=True)
        return [done[key] for key in keys]


def told(record: AgentRecord) -> str:
    """Summarise an episode in one line."""
    outcome, key = record.outcome, record.key
    time = " stepped" if record.time == "stepped" else ""
    reason = f": {outcome.reason}" if outcome.reason else ""
    return (
        f"{key.subject} {key.task} {key.seed}{time} {outcome.status} "
        f"({outcome.calls} calls, {record.costs.wall_s:.1f} s){reason}"
    )


def _played_here(
    plan: AgentPlan, directory: Path, keys: Iterable[AgentKey]
) -> Generator[tuple[AgentRecord, bytes | None], None, None]:
    """Run episodes one after the other in this process."""
    with open_episodes(plan, directory) as episodes:
        for key in keys:
            yield episodes.run(key)


def play_on_workers(
    plan: AgentPlan,
    directory: Path,
    keys: Iterable[AgentKey],
    workers: int,
    ray_address: str | None = None,
) -> Generator[tuple[AgentRecord, bytes | None], None, None]:
    """Run each episode once on Ray workers; yield results in order of completion. A dead or stopped
    worker is replaced, and its episode is run again.

    Raises:
        MissingDependencyError: Ray is not installed.
        ConfigurationError: the cluster cannot be reached or is too small.
        StateError: workers die before they run an episode.
    """
    ray = import_ray()
    # because servers have watchdogs: at Ray's own niceness of 15 a busy machine starves them
    os.environ.setdefault("RAY_worker_niceness", "0")
    connect(ray, ray_address, workers, variables={})
    try:
        actor = ray.remote(num_cpus=1)(AgentWorker)
        text, folder = plan.model_dump_json(), str(directory.resolve())

        def spawn(number: int) -> object:
            return actor.remote(text, folder, _domain(number))

        actors = [spawn(number) for number in range(workers)]
        yield from run_on_actors(ray, actors, spawn, keys, _lost)
    finally:
        ray.shutdown()


class AgentWorker(Located):
    """A worker process, used as a Ray actor.

    Args:
        plan: the plan as JSON.
        directory: directory of the ledger; failed episodes leave their files there.
        domain: ROS domain used by this worker only.
    """

    def __init__(self, plan: str, directory: str, domain: int) -> None:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        self._stack = ExitStack()
        parsed = AgentPlan.model_validate_json(plan)
        self._episodes = self._stack.enter_context(open_episodes(parsed, Path(directory)))

    def run(self, key: AgentKey) -> tuple[AgentRecord, bytes | None]:
        """Like `Episodes.run`."""
        return self._episodes.run(key)


def _domain(number: int) -> int:
    """ROS domain of a worker, different for each."""
    first = int(os.environ.get("ROS_DOMAIN_ID", os.getpid()))
    return _DOMAINS[(first + number) % len(_DOMAINS)]


def _lost(key: AgentKey, cause: str) -> AgentRecord:
    spec = discover().get(AgentTaskSpec, key.task)
    task = cast("AgentTask", build(spec, {}))
    return AgentRecord(
        key=key,
        family=spec.family,
        difficulty=task.difficulty,
        instruction=task.prepare(key.seed).instruction,
        outcome=AgentOutcome(status="error", reason=f"It ended its workers: {cause}"[:500]),
    )


@contextmanager
def open_episodes(plan: AgentPlan, directory: Path) -> Iterator[Episodes]:
    """Create the runner of episodes, with a witness on a ROS domain of this process."""
    registry = discover()
    os.environ.setdefault("ROS_DOMAIN_ID", str(_domain(0)))
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
            plan.transport,
            plan.time,
        )
    finally:
        witness.close()


def packages_of(plan: AgentPlan, registry: Registry) -> list[str]:
    """Distributions that provide the plan's tasks and subjects."""
    wanted = {("agent-task", name) for name in plan.tasks}
    wanted |= {("agent-subject", name) for name in plan.subjects}
    offers = registry.all_offers
    found = {o.distribution for o in offers if (o.spec.kind, o.spec.name) in wanted}
    return sorted(found - {""})

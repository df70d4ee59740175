"""`roboneuron eval agents`: arguments and execution."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron import ConfigurationError

if TYPE_CHECKING:
    from rn_eval.agents.record import AgentPlan

DEFAULT_OUT = Path("out/eval/agents")
COMMAND_SUBJECT = "command"
"""Name of the subject of --subject-command, unless the option gives one before an equals sign."""


def names(text: str) -> tuple[str, ...]:
    """Parse a comma-separated list of the command line."""
    return tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


def configure(parser: ArgumentParser) -> None:
    """Add the arguments."""
    add = parser.add_argument
    add("--subject", type=names, default=(), metavar="A,B", help="installed agents")
    add(
        "--subject-command",
        action="append",
        default=[],
        metavar="[NAME=]COMMAND",
        help="an agent of your own; AGENT_EVAL_SERVER and AGENT_EVAL_INSTRUCTION in its "
        "environment say what to connect to and what to do",
    )
    add("--families", type=names, default=(), metavar="A,B", help="families of tasks; default: all")
    add("--tasks", type=names, default=(), metavar="A,B", help="single tasks")
    add("--seeds", type=int, default=1, help="episodes of each task and agent (default: 1)")
    add("--seed", type=int, default=0, help="the first seed (default: 0)")
    add("--max-s", type=float, default=0.0, help="end every agent after so long at most")
    add(
        "--transport",
        choices=("stdio", "http"),
        default="stdio",
        help="how agents reach the server; with http, AGENT_EVAL_SERVER is a URL and "
        "AGENT_EVAL_TOKEN the bearer token (default: stdio)",
    )
    add(
        "--time",
        choices=("real", "stepped"),
        default="real",
        help="stepped: the simulation waits for commands, so that scripted agents play the same "
        "episode again, whatever the machine does; tasks that cannot be stepped run in real time "
        "(default: real)",
    )
    add("--out", type=Path, default=DEFAULT_OUT, help=f"folder of the run (default: {DEFAULT_OUT})")
    add("--resume", type=Path, metavar="FOLDER", help="go on with a run, as it was begun")
    add("--report", type=Path, metavar="FOLDER", help="only write the report of a run")
    add(
        "--compare",
        type=Path,
        nargs=2,
        metavar=("BEFORE", "AFTER"),
        help="only print what the episodes that two runs have in common cost in each",
    )
    add(
        "--workers",
        type=int,
        default=1,
        help="episodes at a time; more than one needs Ray (default: 1)",
    )
    add("--ray-address", help="a Ray cluster instead of this machine")
    add("--list", action="store_true", help="only list the installed agents and tasks")
    add("--retry-errors", action="store_true", help="run episodes that crashed once more")
    add(
        "--other-versions",
        action="store_true",
        help="go on although packages have other versions than when the run was begun",
    )


def run(arguments: Namespace) -> int:
    """Evaluate, and write the report.

    Returns:
        0; 1 if an episode crashed or a forbidden motion was seen.
    """
    if arguments.list:
        return _list()
    if arguments.compare is not None:
        return _compare(*arguments.compare)
    from rn_eval.agents.report import write_agent_report

    if arguments.report is not None:
        _print(write_agent_report(arguments.report))
        return 0
    from rich.console import Console

    from rn_eval.agents.run import evaluate_agents

    if arguments.workers < 1:
        raise ConfigurationError("--workers must be at least 1.")
    directory: Path = arguments.resume or arguments.out
    records = evaluate_agents(
        _plan(arguments),
        directory,
        Console(highlight=False),
        retry_errors=arguments.retry_errors,
        other_versions=arguments.other_versions,
        workers=arguments.workers,
        ray_address=arguments.ray_address,
    )
    _print(write_agent_report(directory))
    print(f"\nreport: {directory / 'report.html'}")
    bad = [r for r in records if r.outcome.status == "error" or r.outcome.forbidden]
    return 1 if bad else 0


def _plan(arguments: Namespace) -> AgentPlan:
    from rn_eval.agents.record import AgentPlan, agent_versions
    from rn_eval.agents.run import chosen_tasks, packages_of
    from rn_eval.ledger import read_plan_of
    from roboneuron.command import discover

    registry = discover()
    if arguments.resume is not None:
        plan = read_plan_of(arguments.resume, AgentPlan)
    else:
        if arguments.seeds < 1 or arguments.seed < 0 or arguments.max_s < 0:
            raise ConfigurationError("--seeds must be at least 1; --seed and limits at least 0.")
        commands = dict(_named(text) for text in arguments.subject_command)
        subjects = (*arguments.subject, *commands)
        if not subjects:
            raise ConfigurationError(
                "No agent is chosen.",
                hint="Give --subject NAME (see --list) or --subject-command COMMAND.",
            )
        plan = AgentPlan(
            subjects=subjects,
            commands=commands,
            tasks=tuple(chosen_tasks(registry, arguments.families, arguments.tasks)),
            seeds=arguments.seeds,
            first_seed=arguments.seed,
            time_limit_s=arguments.max_s,
            transport=arguments.transport,
            time=arguments.time,
        )
    return plan.model_copy(update={"versions": agent_versions(packages_of(plan, registry))})


def _named(text: str) -> tuple[str, str]:
    name, equals, command = text.partition("=")
    if equals and name.replace("-", "").isalnum() and command.strip():
        return name, command
    return COMMAND_SUBJECT, text


def _list() -> int:
    from rn_eval.hooks import AgentSubjectSpec, AgentTaskSpec
    from roboneuron.command import discover

    registry = discover()
    for name, subject in registry.specs(AgentSubjectSpec).items():
        print(f"agent   {name}  {subject.summary}")
    tasks = registry.specs(AgentTaskSpec).values()
    for task in sorted(tasks, key=lambda task: (task.family, task.name)):
        real = f" (real time: {task.real_time})" if task.real_time else ""
        print(f"{task.family:8}{task.name}  {task.summary}{real}")
    return 0


def _compare(before: Path, after: Path) -> int:
    from rn_eval.agents.compare import compare_agents
    from rn_eval.tables import grid

    print(grid(*compare_agents(before, after)))
    return 0


def _print(report: object) -> None:
    from rn_eval.agents.report import AgentReport
    from rn_eval.tables import grid

    assert isinstance(report, AgentReport)
    print(grid(*report.families))
    print()
    print(grid(*report.scores))

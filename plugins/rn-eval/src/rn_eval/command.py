"""The command `roboneuron eval`."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rn_eval.agents import command as agents
from rn_eval.command_plans import configuration, limit_threads, planned, resumed
from rn_eval.hooks import SuiteSpec
from rn_standard.console.plugin_options import add_option
from roboneuron import ConfigurationError

if TYPE_CHECKING:
    from rn_eval.plan import EvalPlan
    from rn_eval.pools import Pool

EXECUTIONS = ("sequential", "overlap", "rtc", "predicted-state", "auto")


def _names(text: str) -> tuple[str, ...]:
    """Parse a comma-separated list of the command line."""
    return tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


class Eval:
    """Measure how often a policy or an agent succeeds: many simulated episodes, a ledger that
    survives crashes, a report.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron eval`."""
        actions = parser.add_subparsers(
            dest="action", required=True, metavar="ACTION", help="what to do (each: --help)"
        )
        run = actions.add_parser(
            "run", help="run episodes, or the missing ones of an interrupted run"
        )
        self._configure_run(run)
        resume = actions.add_parser("resume", help="resume a run with its own plan")
        resume.add_argument("directory", type=Path, help="folder of the run")
        self._configure_workers(resume)
        report = actions.add_parser("report", help="write the report of one or several runs")
        report.add_argument(
            "directories", type=Path, nargs="+", metavar="DIRECTORY", help="folders of runs"
        )
        report.add_argument("--out", type=Path, help="output folder; default: the first one given")
        report.add_argument(
            "--paper-table",
            action="store_true",
            help="print success by suite and speed-up only, write nothing",
        )
        report.add_argument(
            "--by",
            metavar="FACT[=BOUND,...]",
            help="print success by a fact of the suite's judge only, write nothing",
        )
        actions.add_parser("suites", help="list the installed suites")
        agents.configure(
            actions.add_parser(
                "agents", help="evaluate agents that operate a simulated robot through the tools"
            )
        )
        served = actions.add_parser("serve", help="run as a model server of vla-eval 0.8")
        self._configure_serve(served)

    def _configure_serve(self, parser: ArgumentParser) -> None:
        add = parser.add_argument
        add(
            "--suite",
            default="libero-spatial",
            help="suite whose robot and options are used (default: libero-spatial)",
        )
        self._configure_policy(parser)
        add("--preset", default="none", help="acceleration preset (default: none)")
        add(
            "--host",
            default="127.0.0.1",
            help="address to listen on; there is no authentication (default: 127.0.0.1)",
        )
        add("--port", type=int, default=8000, help="port, 0 for any free one (default: 8000)")

    def _configure_policy(self, parser: ArgumentParser) -> None:
        add = parser.add_argument
        add("--backend", default="servo", help="the policy (default: servo)")
        add("--checkpoint", help="folder of the model's files")
        add("--runtime", help="runtime; default: the backend's own")
        add_option(parser, "the backend")
        add(
            "--config",
            type=Path,
            help="a roboneuron.toml; its limits, control and plugin options are used",
        )
        add(
            "--threads",
            type=int,
            default=1,
            help="threads of each worker's numerical libraries (default: 1)",
        )

    def _configure_run(self, parser: ArgumentParser) -> None:
        add = parser.add_argument
        add("--suite", default="cubes", help="an installed suite (default: cubes)")
        add(
            "--suite-option",
            action="append",
            default=[],
            metavar="NAME=VALUE",
            help="an option of the suite",
        )
        self._configure_policy(parser)
        add(
            "--presets",
            type=_names,
            default=("none",),
            metavar="A,B",
            help='acceleration presets; "none" for none',
        )
        add(
            "--execution",
            type=_names,
            default=("sequential",),
            metavar="A,B",
            help=f"how chunks are played: {', '.join(EXECUTIONS)}",
        )
        add(
            "--latency",
            action="append",
            default=None,
            metavar="L",
            help="latency of a prediction on the episode's clock: 0 (default), 112ms, 0.112s, "
            "lognormal:112ms,0.2, "
            "normal:112ms,10ms, file:PATH or measured; may be given several times",
        )
        add("--episodes", type=int, default=50, help="episodes of each variant (default: 50)")
        add("--seed", type=int, default=0, help="seed of the first episode (default: 0)")
        add(
            "--strips",
            choices=("failures", "all", "none"),
            default="failures",
            help="film strips to keep",
        )
        add(
            "--out",
            type=Path,
            default=Path("out/eval"),
            help="folder of the run (default: out/eval)",
        )
        self._configure_workers(parser)

    def _configure_workers(self, parser: ArgumentParser) -> None:
        add = parser.add_argument
        add(
            "--workers",
            type=int,
            default=1,
            help="concurrent episodes; more than one needs Ray (default: 1)",
        )
        add("--ray-address", help="a Ray cluster instead of this machine")
        add(
            "--policy-actors",
            type=int,
            default=0,
            help="number of processes that serve the policy to all workers, in batches (Ray)",
        )
        add(
            "--policy-gpus",
            type=float,
            default=0.0,
            help="GPUs of each process that holds a policy (Ray)",
        )
        add("--retry-errors", action="store_true", help="run crashed episodes again")
        add(
            "--other-versions",
            action="store_true",
            help="resume although package versions have changed since the start of the run",
        )

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron eval`; status 1 if an episode crashed."""
        if arguments.action == "suites":
            return _list_suites()
        if arguments.action == "agents":
            return agents.run(arguments)
        if arguments.action == "report":
            return _report(arguments)
        if getattr(arguments, "workers", 1) < 1 or getattr(arguments, "threads", 1) < 1:
            raise ConfigurationError("--workers and --threads are at least 1.")
        limit_threads(getattr(arguments, "threads", 1))
        return _serve(arguments) if arguments.action == "serve" else _run(arguments)


def _run(arguments: Namespace) -> int:
    from rich.console import Console

    from rn_eval.evaluate import evaluate
    from rn_eval.report import write_report
    from rn_eval.tables import HEADINGS, cells, grid

    console = Console(highlight=False)
    directory: Path = arguments.directory if arguments.action == "resume" else arguments.out
    plan = resumed(arguments) if arguments.action == "resume" else planned(arguments)
    records = evaluate(
        plan,
        directory,
        _pool(plan, arguments),
        console,
        retry_errors=arguments.retry_errors,
        other_versions=arguments.other_versions,
    )
    summary = write_report([directory], directory)
    print(grid(HEADINGS, [cells(row) for row in summary.rows]))
    print(f"\nreport: {directory / 'report.html'}")
    return 1 if any(record.outcome.status == "error" for record in records) else 0


def _pool(plan: EvalPlan, arguments: Namespace) -> Callable[[], Pool]:
    from rn_eval.pools import InProcess, OnRay

    if arguments.policy_actors and not plan.shared_policy:
        raise ConfigurationError(
            "That run was begun without --policy-actors; batches give other last bits.",
            hint="Leave it out, or begin another run.",
        )
    policy_actors = arguments.policy_actors or int(plan.shared_policy)

    def make() -> Pool:
        if arguments.workers == 1 and arguments.ray_address is None and not policy_actors:
            return InProcess(plan)
        return OnRay(
            plan,
            workers=arguments.workers,
            address=arguments.ray_address,
            policy_actors=policy_actors,
            policy_gpus=arguments.policy_gpus,
        )

    return make


def _serve(arguments: Namespace) -> int:
    import asyncio

    from roboneuron import MissingDependencyError, install_command

    try:
        from rn_eval.model_server import EvalModelServer, run_server
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"Serving needs {error.name}, which is not installed.",
            hint=f"Run: {install_command('rn-eval[serve]')}.",
        ) from error
    from rn_eval.plan import EvalPlan
    from rn_eval.policy import load_backend
    from rn_eval.runner import refuse_early
    from roboneuron import BackendSpec
    from roboneuron.command import discover

    plan = EvalPlan(
        suite=arguments.suite,
        backend=arguments.backend,
        checkpoint=arguments.checkpoint,
        runtime=arguments.runtime,
        config=configuration(arguments),
        presets=(arguments.preset,),
        episodes=1,
        threads=arguments.threads,
    )
    refuse_early(plan)
    registry = discover()
    spec = registry.get(BackendSpec, plan.backend)
    policy = load_backend(plan, registry, arguments.preset)
    server = EvalModelServer(
        policy, name=spec.name, roles=spec.cameras, needs_state=spec.needs_state
    )

    def tell(port: int) -> None:
        print(f"Model server of vla-eval: ws://{arguments.host}:{port}", flush=True)

    try:
        asyncio.run(run_server(server, arguments.host, arguments.port, tell))
    except KeyboardInterrupt:
        return 0
    finally:
        policy.close()
    return 0


def _report(arguments: Namespace) -> int:
    from rn_eval.report import load, write_report
    from rn_eval.tables import HEADINGS, cells, grid, paper_table

    if arguments.paper_table:
        print(paper_table(load(arguments.directories)[0]))
        return 0
    if arguments.by:
        from rn_eval.breakdown import breakdown

        print(breakdown(load(arguments.directories)[0], arguments.by))
        return 0
    output = arguments.out or arguments.directories[0]
    summary = write_report(arguments.directories, output)
    print(grid(HEADINGS, [cells(row) for row in summary.rows]))
    print(f"\nreport: {output / 'report.html'}")
    return 0


def _list_suites() -> int:
    from roboneuron.command import discover

    for name, spec in discover().specs(SuiteSpec).items():
        print(f"{name}  {spec.summary}")
    return 0

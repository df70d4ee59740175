"""Overhead of `roboneuron eval` compared with a plain loop over the same simulator and policy, and
the speed-up of a second worker.

    python benchmarks/bench_eval.py [--episodes 8] [--workers 2]

The plain loop opens the same scene, renders, predicts, computes the joint command and steps the
physics. Loop and evaluation alternate episode by episode; the CPU time of the process is compared,
because other load disturbs it least.
"""

from __future__ import annotations

import argparse
import io
import os
import statistics
import tempfile
import time
from pathlib import Path

from rich.console import Console

from rn_eval.evaluate import evaluate
from rn_eval.ledger import Ledger
from rn_eval.plan import EvalPlan
from rn_eval.pools import InProcess, OnRay
from rn_eval.runner import Runner
from rn_eval.suite import Episode, Scene
from roboneuron import Action, JointCommand
from roboneuron.config import load_config
from roboneuron.plugins.discovery import discover


def plan_of(episodes: int) -> EvalPlan:
    """The suite `cubes` with the policy `servo`."""
    return EvalPlan(
        suite="cubes",
        backend="servo",
        config=load_config(None).model_dump(mode="json"),
        episodes=episodes,
        strips="none",
    )


def plain_episode(runner: Runner, episode: Episode, *, with_limits: bool) -> int:
    """Run an episode without the evaluation's clock, ledger and statistics; returns the number of
    steps.
    """
    policy, setup = runner._policy_of("none"), runner._setup
    policy.reset()
    scene: Scene = runner._suite.open(episode, setup)
    simulation = scene._simulation  # type: ignore[attr-defined]
    steps = 0
    try:
        while simulation.time_s < episode.time_limit_s:
            now_s = simulation.time_s
            observation = scene.observe(1_000_000_000 + round(now_s * 1e9))
            row = policy.predict(observation).actions[0]
            if with_limits:
                scene.act(row, now_s)
            else:
                assert setup.controller is not None
                assert observation.joints is not None
                command = setup.controller.compute(Action.from_vector(row), observation.joints, 0.1)
                if isinstance(command, JointCommand):
                    simulation.set_target(command.names, command.position, command.duration_s)
            simulation.step(24)
            steps += 1
            if scene.judge().is_over:
                break
    finally:
        scene.close()
    return steps


def overhead(count: int) -> None:
    """CPU time of both, episode by episode."""
    plan = plan_of(count)
    runner = Runner(plan)
    jobs = list(plan.jobs(plan.build_suite(discover()).episodes(count + 1, 0)))
    spent: dict[str, list[float]] = {"plain": [], "plain + limits": [], "evaluation": []}
    steps: dict[str, list[int]] = {name: [] for name in spent}
    with tempfile.TemporaryDirectory() as folder, Ledger(Path(folder)) as ledger:
        ledger.open(plan)
        for job in jobs:
            for name in spent:
                begun_s = time.process_time()
                if name == "evaluation":
                    record, strip = runner.run(job)
                    ledger.add(record, strip)
                    done = record.outcome.rows
                else:
                    done = plain_episode(runner, job.episode, with_limits=name != "plain")
                spent[name].append((time.process_time() - begun_s) / done)
                steps[name].append(done)
    print(
        "| one episode of cubes, servo policy | CPU ms a step | steps | to plain | to plain + "
        "limits |"
    )
    print("|---|---|---|---|---|")
    medians = {name: 1e3 * statistics.median(values[1:]) for name, values in spent.items()}
    for name, value in medians.items():
        count_of = statistics.mean(steps[name][1:])
        ratios = [
            statistics.median(a / b for a, b in zip(spent[name][1:], spent[base][1:], strict=True))
            for base in ("plain", "plain + limits")
        ]
        print(f"| {name} | {value:.2f} | {count_of:.1f} | {ratios[0]:.3f} | {ratios[1]:.3f} |")


def scaling(count: int, workers: int) -> None:
    """Episodes per minute with one worker and with several, without the start of Ray."""
    plan = plan_of(count)
    quiet = Console(file=io.StringIO())
    jobs = list(plan.jobs(plan.build_suite(discover()).episodes(count, 0)))
    rates = {}
    for number in (1, workers):
        with OnRay(plan, workers=number) as pool:
            for _ in pool.run(jobs[:number]):  # so that processes have loaded the policy
                pass
            begun_s = time.monotonic()
            done = sum(1 for _ in pool.run(jobs))
            rates[number] = 60 * done / (time.monotonic() - begun_s)
    with tempfile.TemporaryDirectory() as folder:
        begun_s = time.monotonic()
        evaluate(plan, Path(folder), lambda: InProcess(plan), quiet)
        rates[0] = 60 * count / (time.monotonic() - begun_s)
    load = os.getloadavg()[0]
    print(
        f"\n| workers | episodes a minute | to one worker |  load {load:.1f} on {os.cpu_count()} "
        "cores"
    )
    print("|---|---|---|")
    for number, rate in sorted(rates.items()):
        name = "this process" if number == 0 else f"{number} on Ray"
        print(f"| {name} | {rate:.1f} | {rate / rates[1]:.2f} |")


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=8)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", choices=("overhead", "scaling"))
    arguments = parser.parse_args()
    if arguments.only != "scaling":
        overhead(arguments.episodes)
    if arguments.only != "overhead":
        scaling(arguments.episodes, arguments.workers)


if __name__ == "__main__":
    main()

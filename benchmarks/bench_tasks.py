"""run_task compared with the simulator's true state: the servo in PyBullet, with random grasp
failures.

    python benchmarks/bench_tasks.py --runs 200 [--workers 2] [--minutes 5] [--out out/tasks.jsonl]

Each run is a separate scene (its seed determines everything) with the clock of the simulation: the
servo, the controller and its limits, the task's runner, its predicates and its detectors are those
of a running robot; processes and ROS are left out. Images are small (--image-px; a robot's are
224). A grasp fails with the probability --fail in one of two ways: the fingers jam before they
touch the cube, so that the policy assumes a grasp; or they open during the lift. The ledger --out
is continued.

Evaluated: number of tasks that succeed within three attempts (truth: the cube is 10 cm up at the
end of the task), number of outcomes that agree with the simulator, false successes, and the time
from the predicate becoming true to the last motion, in runs that end during the lift.
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, cast

import numpy as np
from simulated_cell import CAMERA_S, FailingGripper, SimulatedCell, lifted, on_the_way_up

from rn_eval.cubes import CubesScene
from rn_eval.plan import EvalPlan
from rn_eval.policy import load_backend
from rn_eval.runner import Runner
from rn_eval.suite import Setup, Suite
from rn_standard.tasks.hooks import MonitorSpec
from rn_standard.tasks.judging import PredicateJudge
from rn_standard.tasks.monitor import Monitor
from rn_standard.tasks.predicates import MonitorSays
from rn_standard.tasks.runner import Outcome, Task, TaskPlan
from roboneuron import Backend
from roboneuron.config import load_config
from roboneuron.modules.plugin import build
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Registry

LEAST_SUCCESS, LEAST_RIGHT = 0.95, 0.99
PERIOD_S = 0.05
"""Period of the task's checks."""
BRAKING_S = 0.5
"""Limit of the motion after the last action: its own 0.1 s and the braking within the arm's
limits.
"""
PAUSE_S = 0.5


@functools.lru_cache(maxsize=1)
def parts(grasps: int, image_px: int) -> tuple[Registry, Setup, Suite, Backend]:
    """Plugins, controller, suite and backend: created once for all runs of a process."""
    config = load_config(None)
    config = config.model_copy(
        update={"plugins": {**config.plugins, "servo": {"max_attempts": grasps}}}
    )
    plan = EvalPlan(
        config=config.model_dump(mode="json"),
        suite="cubes",
        backend="servo",
        episodes=1,
        strips="none",
        suite_options={"camera_hz": 1 / CAMERA_S, "engine": "pybullet", "image_px": image_px},
    )
    registry = discover()
    return (
        registry,
        Runner(plan)._setup,
        plan.build_suite(registry),
        load_backend(plan, registry, "none"),
    )


def play(seed: int, fail: float, grasps: int, braking: bool, image_px: int) -> dict[str, Any]:
    """Run one task in one scene."""
    begun_s = time.perf_counter()
    registry, setup, suite, backend = parts(grasps, image_px)
    episode = suite.episodes(1, seed)[0]
    scene = cast("CubesScene", suite.open(episode, setup))
    try:
        gripper = FailingGripper(scene._simulation, 0.0 if braking else fail, seed)
        cell = SimulatedCell(scene, backend, setup)
        colour = scene._target
        predicate = on_the_way_up() if braking else lifted(colour)

        def monitor(named: MonitorSays) -> Monitor:
            return cast("Monitor", build(registry.get(MonitorSpec, named.name), named.options))

        judge = PredicateJudge(predicate, episode.instruction, monitor)
        task = TaskPlan(
            instruction=episode.instruction, max_s=60.0, max_attempts=3, period_s=PERIOD_S
        )
        told: list[tuple[float, str]] = []
        end = Task(cell, judge, task, lambda text: told.append((cell.now_s(), text))).run()
        cell.wait(PAUSE_S)
        stopped_s = None
        if braking and end.stop_s is not None:
            # The check before the stop found it true; checks are PERIOD_S apart.
            found_s = next(at for at, text in told if "stopping:" in text)
            stopped_s = max(0.0, cell.moved_s - found_s)
        state = scene._simulation.cubes()[colour]
        return {
            "seed": seed,
            "braking": braking,
            "fail": fail,
            "image_px": image_px,
            "most_grasps": grasps,
            "outcome": end.outcome.value,
            "attempts": end.attempts,
            "reason": end.reason,
            "truth": bool(state.lifted_m >= 0.10),
            "lifted_m": round(state.lifted_m, 3),
            "grasps": gripper.grasps,
            "failed_grasps": gripper.failed,
            "simulated_s": round(end.took_s, 2),
            "attempts_failed": [text for _, text in told if ": failed" in text],
            "stopped_s": stopped_s,
            "wall_s": round(time.perf_counter() - begun_s, 1),
        }
    finally:
        scene.close()


def report(lines: list[dict[str, Any]]) -> int:
    """Print the table; status 1 if a bound does not hold."""
    tasks, stops = [x for x in lines if not x["braking"]], [x for x in lines if x["braking"]]
    bad = 0
    if tasks:
        done = [x for x in tasks if x["truth"] and x["outcome"] == Outcome.SUCCEEDED]
        right = [x for x in tasks if _is_right(x)]
        false = [x for x in tasks if x["outcome"] == Outcome.SUCCEEDED and not x["truth"]]
        grasps, failed = sum(x["grasps"] for x in tasks), sum(x["failed_grasps"] for x in tasks)
        print(f"runs                     {len(tasks)}")
        print(f"grasps made to fail      {failed} of {grasps} ({failed / max(1, grasps):.0%})")
        print(
            f"succeeded (and true)     {len(done)} ({len(done) / len(tasks):.1%}; at least "
            f"{LEAST_SUCCESS:.0%})"
        )
        print(
            f"in attempt 1, 2, 3       {[sum(x['attempts'] == n for x in done) for n in (1, 2, 3)]}"
        )
        print(
            f"outcome right            {len(right)} ({len(right) / len(tasks):.1%}; at least "
            f"{LEAST_RIGHT:.0%})"
        )
        print(f"false successes          {len(false)} (none allowed)")
        for line in (x for x in tasks if not _is_right(x)):
            print(
                f"  seed {line['seed']}: {line['outcome']}, truth {line['truth']}: {line['reason']}"
            )
        bad += (
            len(done) < LEAST_SUCCESS * len(tasks)
            or len(right) < LEAST_RIGHT * len(tasks)
            or bool(false)
        )
    if stops:
        times = [x["stopped_s"] for x in stops if x["stopped_s"] is not None]
        bound_s = PERIOD_S + CAMERA_S + BRAKING_S
        print(
            f"true -> last motion      {len(times)} runs: median {np.median(times):.2f} s, worst "
            f"{max(times):.2f} s"
        )
        print(
            f"                         (at most {bound_s:.2f}: a look, an action's own time, "
            "braking)"
        )
        bad += max(times) > bound_s or len(times) < len(stops)
    return int(bad > 0)


def _is_right(line: dict[str, Any]) -> bool:
    said = {
        Outcome.SUCCEEDED.value: True,
        Outcome.FAILED.value: False,
        Outcome.TIMED_OUT.value: False,
    }
    return said.get(line["outcome"]) is line["truth"]


def main() -> int:
    """Run the measurements missing in the ledger, and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--braking-runs", type=int, default=10)
    parser.add_argument("--fail", type=float, default=0.4, help="share of the grasps that fail")
    parser.add_argument(
        "--grasps", type=int, default=2, help="grasps that the servo itself tries in an attempt"
    )
    parser.add_argument(
        "--image-px", type=int, default=160, help="width and height of the pictures"
    )
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument(
        "--out", type=Path, default=Path("out/tasks.jsonl"), help="ledger, continued when it exists"
    )
    parser.add_argument(
        "--minutes",
        type=float,
        default=600.0,
        help="begin no further run after so long; go on later",
    )
    arguments = parser.parse_args()
    end_s = time.monotonic() + 60.0 * arguments.minutes
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    lines = (
        [json.loads(line) for line in arguments.out.read_text().splitlines()]
        if arguments.out.exists()
        else []
    )
    mine = {"fail": arguments.fail, "image_px": arguments.image_px, "most_grasps": arguments.grasps}
    lines = [line for line in lines if all(line.get(key) == value for key, value in mine.items())]
    known = {(line["seed"], line["braking"]) for line in lines}
    wanted = [(seed, False) for seed in range(arguments.runs)] + [
        (s, True) for s in range(arguments.braking_runs)
    ]
    left = [(seed, braking) for seed, braking in wanted if (seed, braking) not in known]
    begun_s = time.monotonic()
    with ProcessPoolExecutor(arguments.workers) as pool, arguments.out.open("a") as ledger:
        jobs = [
            pool.submit(play, seed, arguments.fail, arguments.grasps, braking, arguments.image_px)
            for seed, braking in left
        ]
        for job in as_completed(jobs):
            if job.cancelled():
                continue
            lines.append(job.result(timeout=0))
            ledger.write(json.dumps(lines[-1]) + "\n")
            ledger.flush()
            if time.monotonic() > end_s:
                for waiting in jobs:
                    waiting.cancel()
    done = sum(not job.cancelled() for job in jobs)
    print(f"{done} of {len(left)} missing runs in {(time.monotonic() - begun_s) / 60:.1f} minutes")
    return report(lines)


if __name__ == "__main__":
    sys.exit(main())

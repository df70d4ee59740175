"""run_task against the simulator's truth: the servo in PyBullet, with grasps made to fail at
random.

    python benchmarks/bench_tasks.py --runs 200 [--workers 2] [--minutes 5] [--out out/tasks.jsonl]

Each run is a scene of its own (its seed decides everything) by the clock of the simulation: the
servo, the controller and its limits, the task's runner, its predicates and its detectors are those
of a running robot; processes and ROS are left out. Pictures are small (--image-px; a robot's are
224). A grasp fails with the probability --fail in one of two ways: the fingers jam before they
touch the cube, so that the policy believes that it holds something; or they let go on the way up.
The ledger --out is continued.

Judged: how many tasks succeed within three attempts (truth: the cube is 10 cm up when the task has
ended), how many outcomes say what the simulator says, false successes, and the time from the
predicate's becoming true until the last motion, in runs that end in the middle of the lift.
"""

from __future__ import annotations

import argparse
import functools
import json
import random
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from rn_eval.cubes import CubesScene
from rn_eval.plan import EvalPlan
from rn_eval.policy import load_backend
from rn_eval.runner import Runner
from rn_eval.suite import Setup, Suite
from rn_robot_fr3.limits import FINGER_JOINT
from rn_robot_fr3.simulation import STEP_S, ArmSimulation
from rn_standard.tasks.hooks import MonitorSpec
from rn_standard.tasks.judging import PredicateJudge
from rn_standard.tasks.monitor import Monitor
from rn_standard.tasks.predicates import MonitorSays, Predicate, parse_predicate
from rn_standard.tasks.runner import Outcome, PolicyState, Task, TaskPlan
from rn_standard.tasks.snapshot import Snapshot, StillClock
from roboneuron import Backend, Observation, RoboNeuronError
from roboneuron.config import load_config
from roboneuron.modules.plugin import build
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Registry
from roboneuron.server.tool import Picture

LEAST_SUCCESS, LEAST_RIGHT = 0.95, 0.99
CAMERA_S = 0.1
"""Period of images and of the servo's actions."""
PERIOD_S = 0.05
"""Period of the task's looks."""
BRAKING_S = 0.5
"""Bound on what follows the last action: its own 0.1 s and the way to rest, by the arm's limits."""
STILL_RAD_S = 0.01
CLOSED_M, JAMMED_M = 0.01, 0.031
LETS_GO_M = (0.03, 0.17)
PAUSE_S = 0.5


class FailingGripper:
    """Stands between the driver's commands and the simulation."""

    def __init__(self, simulation: ArmSimulation, share: float, seed: int) -> None:
        self._simulation = simulation
        self._set_target = simulation.set_target
        self._random = random.Random(seed)
        self._share = share
        self._fault = ""
        self._open = True
        self._let_go_m = 0.0
        self.grasps = self.failed = 0
        simulation.set_target = self.command  # type: ignore[method-assign]

    def command(self, names: Any, position: Any, duration_s: float) -> Any:
        """As `ArmSimulation.set_target`, with what goes wrong."""
        wanted = np.array(position, dtype=float)
        if FINGER_JOINT in names:
            finger = list(names).index(FINGER_JOINT)
            self._note(float(wanted[finger]))
            if self._fault == "jams":
                wanted[finger] = max(wanted[finger], JAMMED_M)
            if (
                self._fault == "lets go"
                and self._simulation.tcp_pose().position_m[2] > self._let_go_m
            ):
                wanted[finger] = 0.04
                if self._simulation.gripper_open() > 0.9:
                    self._fault = "has let go"
        return self._set_target(names, wanted, duration_s)

    def _note(self, target: float) -> None:
        """Draw what becomes of a grasp when it begins."""
        if target > CLOSED_M:
            self._open = True
            if self._fault != "lets go":
                self._fault = ""
        elif self._open:
            self._open = False
            self.grasps += 1
            self._fault = ""
            if self._random.random() < self._share:
                self.failed += 1
                self._fault = self._random.choice(["jams", "lets go"])
                self._let_go_m = self._simulation.tcp_pose().position_m[2] + self._random.uniform(
                    *LETS_GO_M
                )


class SimulatedCell:
    """Follows `rn_standard.tasks.runner.Cell`, by the clock of a stepped simulation."""

    def __init__(self, scene: CubesScene, backend: Backend, setup: Setup) -> None:
        self._scene, self._backend, self._setup = scene, backend, setup
        self.simulation: ArmSimulation = scene._simulation
        self._tick = 0
        self._observation: Observation = scene.observe(1)
        self._instruction = ""
        self._failure, self._done, self._acted = "", False, False
        self._still = StillClock()
        self.moved_s = 0.0
        """Last time at which a joint of the arm moved."""

    def now_s(self) -> float:
        return self._tick * STEP_S

    def wait(self, seconds: float) -> bool:
        for _ in range(round(seconds / STEP_S)):
            if self._tick % round(CAMERA_S / STEP_S) == 0:
                self._act()
            self._scene.advance(1)
            self._tick += 1
            velocity = self.simulation.joint_states()[1]
            if np.abs(velocity[:7]).max() > STILL_RAD_S:
                self.moved_s = self.now_s()
        return False

    def _act(self) -> None:
        """A camera period: new images, and an action for them."""
        self._scene.watch(self.now_s())
        self._observation = replace(
            self._scene.observe(round(self.now_s() * 1e9) + 1), instruction=""
        )
        if not self._instruction:
            return
        try:
            chunk = self._backend.predict(replace(self._observation, instruction=self._instruction))
        except RoboNeuronError as error:
            self._failure = str(error)
            return
        self._failure, self._done, self._acted = "", chunk.metrics["done"] >= 0.5, True
        self._scene.act(chunk.actions[0], self.now_s())

    def begin(self, instruction: str) -> None:
        self._backend.reset()
        self._instruction = instruction
        self._failure, self._done, self._acted = "", False, False

    def policy(self) -> PolicyState:
        return PolicyState(has_acted=self._acted, failure=self._failure)

    def look(self) -> Snapshot:
        position, _ = self.simulation.joint_states()
        joints = dict(zip(map(str, range(9)), position.tolist(), strict=True))
        return Snapshot(
            now_s=self.now_s(),
            joints=joints,
            tcp=self._observation.ee_pose
            if self._observation.ee_pose is None
            else self.simulation.tcp_pose(),
            gripper_open=self.simulation.gripper_open(),
            still_s=self._still.observe(self.now_s(), joints),
            policy_done=self._done if self._acted else None,
            frames=self._observation.frames,
        )

    def end(self) -> None:
        self._instruction = ""

    def evidence(self) -> tuple[Picture, ...]:
        return ()


def lifted(colour: str) -> Predicate:
    """The colour's cube is lifted and held for a second."""
    return parse_predicate(
        {
            "kind": "held",
            "for_s": 1.0,
            "of": {
                "kind": "all",
                "of": [
                    {"kind": "gripper_holds", "least_open": 0.15, "most_open": 0.9},
                    {
                        "kind": "monitor",
                        "name": "colour-lifted",
                        "options": {"colour": colour, "height_m": 0.12},
                    },
                ],
            },
        }
    )


def on_the_way_up() -> Predicate:
    """The gripper holds something and is in the middle of the lift."""
    box = {"kind": "tcp_in", "lower_m": [0, -1, 0.10], "upper_m": [1, 1, 1]}
    return parse_predicate(
        {"kind": "all", "of": [{"kind": "gripper_holds", "most_open": 0.8}, box]}
    )


@functools.lru_cache(maxsize=1)
def parts(grasps: int, image_px: int) -> tuple[Registry, Setup, Suite, Backend]:
    """Plugins, controller, suite and backend: made once for all runs of a process."""
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
    """One task in one scene."""
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
            # The look that found it true was the one before the stop; looks are PERIOD_S apart.
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
    """Print the table; status 1 when a bound does not hold."""
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
    """Measure what is missing from the ledger, and print."""
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

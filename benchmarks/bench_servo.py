"""Success rate of the backend "servo" in lifting the named cube: servo -> controller "urdf" ->
simulated FR3, headless.

    python benchmarks/bench_servo.py [--seeds 50] [--jobs 2] [--latency-frames 1] [--cameras
    front,wrist]
                                     [--added-latency-ms 300] [--rows 12]

One process per job, no ROS: everything runs at 10 Hz of simulated time, as fast as the machine
allows. Images are one frame (100 ms) older than the pose with them. Each seed is a scene of four
cubes; the named colour is random. Only the simulator's own state counts: the named cube must be at
least 10 cm above its initial position, for one second without interruption, and no other cube. The
floor is the cost of the bare simulation (physics and both images) of the same steps. With
--added-latency-ms each answer of the servo is delayed by that simulated time; the executor of the
inference module executes its chunks meanwhile, and the table shows the rate. Exit status 1 below 95
%.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from servo_episode import PERIOD_S, Episode, Job, play_at_once, play_overlapped, save_strip

from rn_robot_fr3.simulation import ArmSimulation
from roboneuron.modules.execution.mode import MODES

SCENE_S = 900.0
"""Time limit of one scene; on an idle machine it takes about 10 s."""
LEAST_SHARE = 0.95
ROWS_WITH_LATENCY = 12


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """Result of one scene.

    Attributes:
        seed, instruction: the scene.
        is_lifted: from the simulator's state.
        reason: why it was not lifted; empty if it was.
        simulated_s: time until it was held, or given up.
        failed_attempts: grasps that the servo had to repeat.
        holds: refusals of the controller by code.
        predict_ms, simulate_ms: median wall time per step of the servo, and of physics and images.
            mode, rate, starved_periods, longest_gap_s: of chunk execution; empty, 1 and 0 without
            added latency.
    """

    seed: int
    instruction: str
    is_lifted: bool
    reason: str
    simulated_s: float
    failed_attempts: int
    holds: dict[str, int]
    predict_ms: float
    simulate_ms: float
    mode: str
    rate: float
    starved_periods: int
    longest_gap_s: float


def run(job: Job) -> Outcome:
    """Run one scene to its end."""
    with ArmSimulation(job.seed) as simulation:
        episode = Episode(job, simulation)
        mode, rate, starved_periods, longest_gap_s = "", 1.0, 0, 0.0
        if job.added_latency_s is None:
            play_at_once(episode)
        else:
            status = play_overlapped(episode, job.added_latency_s).status()
            delivery = status.delivery
            mode, rate = status.choice.mode, delivery.rate or 0.0
            starved_periods, longest_gap_s = delivery.starved_periods, delivery.longest_gap_s
        outcome = Outcome(
            seed=job.seed,
            instruction=episode.instruction,
            is_lifted=not episode.reason,
            reason=episode.reason,
            simulated_s=simulation.time_s,
            failed_attempts=episode.attempts,
            holds=dict(episode.holds),
            predict_ms=float(np.median(episode.predict_ms)) if episode.predict_ms else float("nan"),
            simulate_ms=float(np.median(episode.simulate_ms)),
            mode=mode,
            rate=rate,
            starved_periods=starved_periods,
            longest_gap_s=longest_gap_s,
        )
    if job.pictures:
        save_strip(episode.pictures, job.pictures / f"seed{job.seed:03d}.png")
    return outcome


def report(outcomes: list[Outcome], console: Console) -> None:
    """Print the results and every failure."""
    lifted = [o for o in outcomes if o.is_lifted]
    times = [o.simulated_s for o in lifted] or [float("nan")]
    predict = float(np.median([o.predict_ms for o in outcomes]))
    simulate = float(np.median([o.simulate_ms for o in outcomes]))
    holds: Counter[str] = Counter()
    for outcome in outcomes:
        holds.update(outcome.holds)
    table = Table(
        title="Servo on the simulated FR3, judged by the simulator",
        title_justify="left",
        show_header=False,
    )
    table.add_row(
        "lifted >= 10 cm and held 1 s",
        f"{len(lifted)} of {len(outcomes)}  ({len(lifted) / len(outcomes):.0%})",
    )
    table.add_row(
        "without a failed grasp", f"{sum(o.failed_attempts == 0 for o in lifted)} of {len(lifted)}"
    )
    table.add_row("simulated time, median / max", f"{np.median(times):.1f} / {max(times):.1f} s")
    table.add_row(
        "refusals of the controller",
        ", ".join(f"{n} {code}" for code, n in holds.items()) or "none",
    )
    table.add_row("servo per step, median", f"{predict:.1f} ms")
    table.add_row("floor: physics and pictures per step, median", f"{simulate:.1f} ms")
    table.add_row("servo over floor", f"{predict / simulate:.2f}x")
    if outcomes[0].mode:
        modes = Counter(o.mode for o in outcomes)
        table.add_row("execution", ", ".join(f"{mode} ({n})" for mode, n in modes.items()))
        rates = [o.rate / PERIOD_S for o in outcomes]
        table.add_row("rate delivered, mean / least", f"{np.mean(rates):.2f} / {min(rates):.2f} Hz")
        table.add_row("starved periods, all scenes", str(sum(o.starved_periods for o in outcomes)))
        table.add_row("longest gap", f"{max(o.longest_gap_s for o in outcomes) * 1e3:.0f} ms")
    console.print(table)
    for outcome in outcomes:
        if not outcome.is_lifted:
            console.print(
                f"[red]seed {outcome.seed}[/red] {outcome.instruction!r}: {outcome.reason}"
            )


def main() -> int:
    """Run all seeds and check the bound."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--seeds", type=int, default=50, help="number of scenes (default 50)")
    parser.add_argument(
        "--first-seed", type=int, default=0, help="seed of the first scene (default 0)"
    )
    parser.add_argument(
        "--jobs", type=int, default=1, help="scenes played at the same time (default 1)"
    )
    parser.add_argument(
        "--latency-frames",
        type=int,
        default=1,
        help="age of the images in frames of 0.1 s (default 1)",
    )
    parser.add_argument(
        "--cameras", default="front,wrist", help="cameras the servo gets (default front,wrist)"
    )
    parser.add_argument("--pictures", type=Path, help="folder for a strip of pictures per seed")
    parser.add_argument(
        "--added-latency-ms", type=float, help="each answer comes so much later, in simulated time"
    )
    parser.add_argument(
        "--rows", type=int, help="rows of a chunk (default 12 with added latency, else 1)"
    )
    parser.add_argument(
        "--mode", choices=MODES, help="how chunks are executed (default: chosen by the latency)"
    )
    arguments = parser.parse_args()
    added_ms = arguments.added_latency_ms
    jobs = [
        Job(
            seed=seed,
            latency_frames=arguments.latency_frames,
            cameras=tuple(arguments.cameras.split(",")),
            pictures=arguments.pictures,
            added_latency_s=None if added_ms is None else added_ms / 1e3,
            rows=arguments.rows or (1 if added_ms is None else ROWS_WITH_LATENCY),
            mode=arguments.mode,
        )
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    ]
    console = Console()
    with multiprocessing.get_context("spawn").Pool(arguments.jobs) as pool:
        # with a time limit, because a worker that dies never answers
        waiting = [pool.apply_async(run, [job]) for job in jobs]
        bounded = (result.get(SCENE_S) for result in waiting)
        outcomes = list(track(bounded, total=len(jobs), description="scenes", console=console))
    report(outcomes, console)
    return 0 if sum(o.is_lifted for o in outcomes) >= LEAST_SHARE * len(outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())

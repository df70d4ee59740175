"""How often the backend "servo" lifts the cube it is told to: servo -> controller "urdf" -> simulated FR3, headless.

    python benchmarks/bench_servo.py [--seeds 50] [--jobs 2] [--latency-frames 1] [--cameras front,wrist]

One process per job, no ROS: everything runs at 10 Hz of simulated time, as fast as the machine allows. Images are one
frame (100 ms) older than the pose that comes with them. Each seed is a scene of four cubes; the named colour is random.
Only the simulator's own state counts: the named cube is at least 10 cm above where it lay, for one second without a
break, and no other cube is. The floor is what the bare simulation (physics and both pictures) of the same steps costs.
Exit status 1 below 95 %.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from collections import Counter, deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from rich.console import Console
from rich.progress import track
from rich.table import Table

from rn_backend_servo.backend import ServoBackend
from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.profile import profile as fr3_profile
from rn_robot_fr3.simulation import JOINTS, STEP_S, Simulation
from roboneuron.contract import Action, Frame, Hold, JointSample, Observation
from roboneuron.errors import RoboNeuronError

PERIOD_S = 0.1
MOST_S = 60.0
HELD_S = 1.0
LEAST_SHARE = 0.95
PHRASES = ("pick up the {} cube", "grab the {} block", "Please lift the {} box.", "take the {} one", "GET THE {} CUBE!")


@dataclass(frozen=True, kw_only=True, slots=True)
class Job:
    """One scene to try."""

    seed: int
    latency_frames: int
    cameras: tuple[str, ...]
    pictures: Path | None


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """What became of one scene.

    Attributes:
        seed, instruction: which one.
        is_lifted: judged by the simulator's state.
        reason: why not; empty when it was.
        simulated_s: time until it was held, or given up.
        failed_attempts: grasps that the servo had to repeat.
        holds: refusals of the controller by code.
        predict_ms, simulate_ms: median wall time per step of the servo, and of physics and pictures.
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


def look(simulation: Simulation, cameras: tuple[str, ...]) -> dict[str, Frame]:
    """A frame by role of each camera, stamped with simulated time."""
    frames = {}
    for camera in fr3_profile().cameras:
        if camera.name in cameras:
            frames[camera.role] = Frame(
                camera=camera.name,
                image=simulation.render(camera.name, camera.width, camera.height),
                stamp_ns=round(simulation.time_s * 1e9),
                frame_id=camera.frame_id,
                calibration=camera.calibration,
            )
    return frames


def save_strip(pictures: list[np.ndarray], path: Path) -> None:
    """Every picture of an episode in rows of ten."""
    rows = [pictures[i : i + 10] for i in range(0, len(pictures), 10)]
    blank = np.zeros_like(pictures[0])
    rows[-1] += [blank] * (len(rows[0]) - len(rows[-1]))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate([np.concatenate(row, axis=1) for row in rows])).save(path)


def run(job: Job) -> Outcome:
    """Play one scene to its end."""
    random = np.random.default_rng([job.seed, 7])
    robot = fr3_profile()
    assert robot.gripper is not None
    servo, controller = ServoBackend(None), UrdfController(None, robot)
    servo.load()
    controller.load()
    holds: Counter[str] = Counter()
    predict_ms: list[float] = []
    simulate_ms: list[float] = []
    pictures: list[np.ndarray] = []
    reason, error_steps, attempts = "time ran out", 0, 0
    with Simulation(job.seed) as simulation:
        colour = str(random.choice(sorted(simulation.cubes())))
        instruction = PHRASES[int(random.integers(len(PHRASES)))].format(colour)
        delayed = deque([look(simulation, job.cameras)], maxlen=job.latency_frames + 1)
        while simulation.time_s < MOST_S:
            start = time.perf_counter()
            simulation.step(round(PERIOD_S / STEP_S))
            delayed.append(look(simulation, job.cameras))
            simulate_ms.append((time.perf_counter() - start) * 1e3)
            frames = delayed[0]
            joints = JointSample(
                names=JOINTS, position=simulation.joint_positions(), stamp_ns=round(simulation.time_s * 1e9)
            )
            observation = Observation(
                frames=frames,
                instruction=instruction,
                joints=joints,
                ee_pose=controller.forward(joints),
                gripper_open=simulation.gripper_open(),
                stamp_ns=min(frame.stamp_ns for frame in frames.values()),
            )
            if job.pictures and round(simulation.time_s / PERIOD_S) % 5 == 0:
                pictures.append(np.concatenate([frame.image for frame in delayed[-1].values()]))
            if len(delayed) <= job.latency_frames:
                continue
            start = time.perf_counter()
            try:
                chunk = servo.predict(observation)
            except RoboNeuronError as error:
                reason, error_steps = str(error), error_steps + 1
                simulation.hold()
                if error_steps > 30:
                    break
                continue
            predict_ms.append((time.perf_counter() - start) * 1e3)
            attempts = int(chunk.metrics["failed_attempts"])
            answer = controller.compute(Action.from_vector(chunk.actions[0]), joints, PERIOD_S)
            if isinstance(answer, Hold):
                holds[answer.code] += 1
                reason = f"time ran out while {chunk.note}; last refusal: {answer.reason}"
                simulation.hold()
            else:
                simulation.set_target(answer.names, answer.position, answer.duration_s)
                reason = f"time ran out while {chunk.note}"
            cubes = simulation.cubes()
            if cubes[colour].held_s >= HELD_S:
                others = [name for name, cube in cubes.items() if name != colour and cube.held_s > 0]
                reason = f"lifted {', '.join(others)} as well" if others else ""
                break
        outcome = Outcome(
            seed=job.seed,
            instruction=instruction,
            is_lifted=not reason,
            reason=reason,
            simulated_s=simulation.time_s,
            failed_attempts=attempts,
            holds=dict(holds),
            predict_ms=float(np.median(predict_ms)) if predict_ms else float("nan"),
            simulate_ms=float(np.median(simulate_ms)),
        )
    if job.pictures:
        save_strip(pictures, job.pictures / f"seed{job.seed:03d}.png")
    return outcome


def report(outcomes: list[Outcome], console: Console) -> None:
    """Print the figures and every failure."""
    lifted = [o for o in outcomes if o.is_lifted]
    times = [o.simulated_s for o in lifted] or [float("nan")]
    predict = float(np.median([o.predict_ms for o in outcomes]))
    simulate = float(np.median([o.simulate_ms for o in outcomes]))
    holds: Counter[str] = Counter()
    for outcome in outcomes:
        holds.update(outcome.holds)
    table = Table(title="Servo on the simulated FR3, judged by the simulator", title_justify="left", show_header=False)
    table.add_row(
        "lifted >= 10 cm and held 1 s", f"{len(lifted)} of {len(outcomes)}  ({len(lifted) / len(outcomes):.0%})"
    )
    table.add_row("without a failed grasp", f"{sum(o.failed_attempts == 0 for o in lifted)} of {len(lifted)}")
    table.add_row("simulated time, median / max", f"{np.median(times):.1f} / {max(times):.1f} s")
    table.add_row("refusals of the controller", ", ".join(f"{n} {code}" for code, n in holds.items()) or "none")
    table.add_row("servo per step, median", f"{predict:.1f} ms")
    table.add_row("floor: physics and pictures per step, median", f"{simulate:.1f} ms")
    table.add_row("servo over floor", f"{predict / simulate:.2f}x")
    console.print(table)
    for outcome in outcomes:
        if not outcome.is_lifted:
            console.print(f"[red]seed {outcome.seed}[/red] {outcome.instruction!r}: {outcome.reason}")


def main() -> int:
    """Run all seeds and judge."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=50, help="number of scenes (default 50)")
    parser.add_argument("--first-seed", type=int, default=0, help="seed of the first scene (default 0)")
    parser.add_argument("--jobs", type=int, default=1, help="scenes played at the same time (default 1)")
    parser.add_argument(
        "--latency-frames", type=int, default=1, help="age of the images in frames of 0.1 s (default 1)"
    )
    parser.add_argument("--cameras", default="front,wrist", help="cameras the servo gets (default front,wrist)")
    parser.add_argument("--pictures", type=Path, help="folder for a strip of pictures per seed")
    arguments = parser.parse_args()
    jobs = [
        Job(
            seed=seed,
            latency_frames=arguments.latency_frames,
            cameras=tuple(arguments.cameras.split(",")),
            pictures=arguments.pictures,
        )
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    ]
    console = Console()
    with multiprocessing.get_context("spawn").Pool(arguments.jobs) as pool:
        outcomes = list(track(pool.imap(run, jobs), total=len(jobs), description="scenes", console=console))
    report(outcomes, console)
    return 0 if sum(o.is_lifted for o in outcomes) >= LEAST_SHARE * len(outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())

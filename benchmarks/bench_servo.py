"""How often the backend "servo" lifts the cube it is told to: servo -> controller "urdf" ->
simulated FR3, headless.

    python benchmarks/bench_servo.py [--seeds 50] [--jobs 2] [--latency-frames 1] [--cameras
    front,wrist]
                                     [--added-latency-ms 300] [--rows 12]

One process per job, no ROS: everything runs at 10 Hz of simulated time, as fast as the machine
allows. Images are one frame (100 ms) older than the pose that comes with them. Each seed is a scene
of four cubes; the named colour is random. Only the simulator's own state counts: the named cube is
at least 10 cm above where it lay, for one second without a break, and no other cube is. The floor
is what the bare simulation (physics and both pictures) of the same steps costs. With
--added-latency-ms each answer of the servo comes so much later in simulated time; the executor of
the inference module plays its chunks meanwhile, and the table tells at which rate. Exit status 1
below 95 %.
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
from rn_backend_servo.options import ServoOptions
from rn_backend_servo.plugin import roboneuron_backends
from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.profile import profile as fr3_profile
from rn_robot_fr3.simulation import JOINTS, STEP_S, ArmSimulation
from rn_standard.execution.adaptive import AdaptiveExecutor
from rn_standard.execution.mode import MODES, Abilities, Mode
from rn_standard.inference.execution import Bounds, Prediction
from roboneuron.contract import Action, ActionChunk, Frame, Hold, JointSample, Observation
from roboneuron.errors import NotReadyError, RoboNeuronError

PERIOD_S = 0.1
MOST_S = 60.0
SCENE_S = 900.0
"""Bound on the wait for one scene; on an idle machine it takes some 10 s."""
HELD_S = 1.0
LEAST_SHARE = 0.95
TICK_STEPS = 6
TICKS_PER_PERIOD = round(PERIOD_S / STEP_S) // TICK_STEPS
ROUNDING_S = 1e-6
MAX_IMAGE_AGE_S = 0.5
MOST_ERRORS = 30
ROWS_WITH_LATENCY = 12
PHRASES = (
    "pick up the {} cube",
    "grab the {} block",
    "Please lift the {} box.",
    "take the {} one",
    "GET THE {} CUBE!",
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Job:
    """One scene to try."""

    seed: int
    latency_frames: int
    cameras: tuple[str, ...]
    pictures: Path | None
    added_latency_s: float | None
    rows: int
    mode: Mode | None


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
        predict_ms, simulate_ms: median wall time per step of the servo, and of physics and
            pictures.
        mode, rate, starved_periods, longest_gap_s: of chunk execution; empty, 1 and 0 without added
            latency.
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


def look(simulation: ArmSimulation, cameras: tuple[str, ...]) -> dict[str, Frame]:
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


class Episode:
    """One scene: the simulated arm, the servo and the controller, and what is noted of them."""

    def __init__(self, job: Job, simulation: ArmSimulation) -> None:
        random = np.random.default_rng([job.seed, 7])
        self.job, self.simulation = job, simulation
        self.servo, self.controller = (
            ServoBackend(ServoOptions(rows=job.rows)),
            UrdfController(None, fr3_profile()),
        )
        self.servo.load()
        self.controller.load()
        self.colour = str(random.choice(sorted(simulation.cubes())))
        self.instruction = PHRASES[int(random.integers(len(PHRASES)))].format(self.colour)
        self.holds: Counter[str] = Counter()
        self.predict_ms: list[float] = []
        self.simulate_ms: list[float] = []
        self.pictures: list[np.ndarray] = []
        self.reason, self.note, self.errors, self.attempts = "time ran out", "", 0, 0
        self.delayed = deque([look(simulation, job.cameras)], maxlen=job.latency_frames + 1)

    def look(self) -> None:
        """Take the pictures of one period."""
        self.delayed.append(look(self.simulation, self.job.cameras))
        if self.job.pictures and round(self.simulation.time_s / PERIOD_S) % 5 == 0:
            self.pictures.append(
                np.concatenate([frame.image for frame in self.delayed[-1].values()])
            )

    def joints(self) -> JointSample:
        """Measured now."""
        simulation = self.simulation
        return JointSample(
            names=JOINTS,
            position=simulation.joint_positions(),
            stamp_ns=round(simulation.time_s * 1e9),
        )

    def observe(self) -> Observation | None:
        """The newest images that have arrived and the newest state; None before the first."""
        if len(self.delayed) <= self.job.latency_frames:
            return None
        frames, joints = self.delayed[0], self.joints()
        return Observation(
            frames=frames,
            instruction=self.instruction,
            joints=joints,
            ee_pose=self.controller.forward(joints),
            gripper_open=self.simulation.gripper_open(),
            stamp_ns=min(frame.stamp_ns for frame in frames.values()),
        )

    def predict(self, observation: Observation) -> ActionChunk | None:
        """Ask the servo; None when it refuses."""
        start = time.perf_counter()
        try:
            chunk = self.servo.predict(observation)
        except RoboNeuronError as error:
            self.reason, self.errors = str(error), self.errors + 1
            return None
        self.predict_ms.append((time.perf_counter() - start) * 1e3)
        self.attempts, self.note = int(chunk.metrics["failed_attempts"]), chunk.note
        return chunk

    def act(self, vector: np.ndarray) -> None:
        """Carry one action out."""
        answer = self.controller.compute(Action.from_vector(vector), self.joints(), PERIOD_S)
        if isinstance(answer, Hold):
            self.holds[answer.code] += 1
            self.reason = f"time ran out while {self.note}; last refusal: {answer.reason}"
            self.simulation.hold()
        else:
            self.simulation.set_target(answer.names, answer.position, answer.duration_s)
            self.reason = f"time ran out while {self.note}"

    def is_over(self) -> bool:
        """The cube is held for long enough, or nothing can come of it any more."""
        cubes = self.simulation.cubes()
        if cubes[self.colour].held_s >= HELD_S:
            others = [
                name for name, cube in cubes.items() if name != self.colour and cube.held_s > 0
            ]
            self.reason = f"lifted {', '.join(others)} as well" if others else ""
            return True
        return self.errors > MOST_ERRORS or self.simulation.time_s >= MOST_S


def play_at_once(episode: Episode) -> None:
    """A prediction every period, carried out in the same moment."""
    while not episode.is_over():
        start = time.perf_counter()
        episode.simulation.step(round(PERIOD_S / STEP_S))
        episode.look()
        episode.simulate_ms.append((time.perf_counter() - start) * 1e3)
        observation = episode.observe()
        if observation is None:
            continue
        chunk = episode.predict(observation)
        if chunk is None:
            episode.simulation.hold()
        else:
            episode.act(chunk.actions[0])


def play_overlapped(episode: Episode, added_latency_s: float) -> AdaptiveExecutor:
    """Answers come late; the executor decides, by simulated time, when to predict and which row to
    send.
    """
    job, simulation = episode.job, episode.simulation
    abilities = Abilities(conditions_on_rows=roboneuron_backends()[0].conditions_on_rows)
    executor = AdaptiveExecutor(abilities, fixed=job.mode, bounds=Bounds(first_s=MAX_IMAGE_AGE_S))
    executor.begin_epoch()
    pending: tuple[float, Prediction, ActionChunk] | None = None
    used_ns, ticks = -1, 0
    while not episode.is_over():
        start = time.perf_counter()
        simulation.step(TICK_STEPS)
        ticks += 1
        if ticks % TICKS_PER_PERIOD == 0:
            episode.look()
        episode.simulate_ms.append((time.perf_counter() - start) * 1e3 * TICKS_PER_PERIOD)
        now_s, now_ns = simulation.time_s, round(simulation.time_s * 1e9)
        if pending is not None and now_s >= pending[0] - ROUNDING_S:
            executor.answer(pending[1], pending[2], now_ns)
            pending = None
        observation = (
            episode.observe() if pending is None and executor.wants_prediction(now_s) else None
        )
        captured_ns = observation.frames["primary"].stamp_ns if observation is not None else used_ns
        if observation is not None and captured_ns > used_ns:
            used_ns = captured_ns
            prediction = executor.begin(observation, captured_ns)
            chunk = episode.predict(prediction.observation)
            pending = None if chunk is None else (now_s + added_latency_s, prediction, chunk)
        try:
            row = executor.play(now_s, now_ns)
        except NotReadyError as error:
            episode.reason, row = str(error), None
        if row is not None:
            episode.act(row.vector)
    return executor


def run(job: Job) -> Outcome:
    """Play one scene to its end."""
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
    """Print the figures and every failure."""
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
    """Run all seeds and judge."""
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
        # each waited for: a worker that dies never answers
        waiting = [pool.apply_async(run, [job]) for job in jobs]
        bounded = (result.get(SCENE_S) for result in waiting)
        outcomes = list(track(bounded, total=len(jobs), description="scenes", console=console))
    report(outcomes, console)
    return 0 if sum(o.is_lifted for o in outcomes) >= LEAST_SHARE * len(outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())

"""One simulated scene solved by visual servoing, with immediate or late answers."""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from rn_backend_servo.backend import ServoBackend
from rn_backend_servo.options import ServoOptions
from rn_backend_servo.plugin import roboneuron_backends
from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.profile import profile as fr3_profile
from rn_robot_fr3.simulation import JOINTS, STEP_S, ArmSimulation
from roboneuron.contract import Action, ActionChunk, Frame, Hold, JointSample, Observation
from roboneuron.errors import NotReadyError, RoboNeuronError
from roboneuron.modules.execution.adaptive import AdaptiveExecutor
from roboneuron.modules.execution.mode import Abilities, Mode
from roboneuron.modules.inference.execution import Bounds, Prediction

PERIOD_S = 0.1
MOST_S = 60.0
HELD_S = 1.0
TICK_STEPS = 6
TICKS_PER_PERIOD = round(PERIOD_S / STEP_S) // TICK_STEPS
ROUNDING_S = 1e-6
MAX_IMAGE_AGE_S = 0.5
MOST_ERRORS = 30
PHRASES = (
    "pick up the {} cube",
    "grab the {} block",
    "Please lift the {} box.",
    "take the {} one",
    "GET THE {} CUBE!",
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Job:
    """One scene to run."""

    seed: int
    latency_frames: int
    cameras: tuple[str, ...]
    pictures: Path | None
    added_latency_s: float | None
    rows: int
    mode: Mode | None


def look(simulation: ArmSimulation, cameras: tuple[str, ...]) -> dict[str, Frame]:
    """Render one frame of each named camera, by role, stamped with simulated time."""
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
    """Save all pictures of an episode in rows of ten."""
    rows = [pictures[i : i + 10] for i in range(0, len(pictures), 10)]
    blank = np.zeros_like(pictures[0])
    rows[-1] += [blank] * (len(rows[0]) - len(rows[-1]))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate([np.concatenate(row, axis=1) for row in rows])).save(path)


class Episode:
    """One scene: the simulated arm, the servo and the controller, with the results recorded."""

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
        """Render the images of one period."""
        self.delayed.append(look(self.simulation, self.job.cameras))
        if self.job.pictures and round(self.simulation.time_s / PERIOD_S) % 5 == 0:
            self.pictures.append(
                np.concatenate([frame.image for frame in self.delayed[-1].values()])
            )

    def joints(self) -> JointSample:
        """Measured joints now."""
        simulation = self.simulation
        return JointSample(
            names=JOINTS,
            position=simulation.joint_positions(),
            stamp_ns=round(simulation.time_s * 1e9),
        )

    def observe(self) -> Observation | None:
        """The newest images that have arrived, with the newest state; None before the first
        image.
        """
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
        """Ask the servo for a prediction; None when it refuses."""
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
        """Execute one action."""
        answer = self.controller.compute(Action.from_vector(vector), self.joints(), PERIOD_S)
        if isinstance(answer, Hold):
            self.holds[answer.code] += 1
            self.reason = f"time ran out while {self.note}; last refusal: {answer.reason}"
            self.simulation.hold()
        else:
            self.simulation.set_target(answer.names, answer.position, answer.duration_s)
            self.reason = f"time ran out while {self.note}"

    def is_over(self) -> bool:
        """Whether the cube was held long enough, or the episode can no longer succeed."""
        cubes = self.simulation.cubes()
        if cubes[self.colour].held_s >= HELD_S:
            others = [
                name for name, cube in cubes.items() if name != self.colour and cube.held_s > 0
            ]
            self.reason = f"lifted {', '.join(others)} as well" if others else ""
            return True
        return self.errors > MOST_ERRORS or self.simulation.time_s >= MOST_S


def play_at_once(episode: Episode) -> None:
    """Predict once per period and execute the action immediately."""
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
    """Deliver answers late; the executor decides, by simulated time, when to predict and which row
    to send.
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

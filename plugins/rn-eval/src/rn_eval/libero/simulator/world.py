"""One LIBERO task in its simulator, stepped as the public evaluation scripts step it.

Sources: openvla/openvla and moojink/openvla-oft,
experiments/robot/libero/{run_libero_eval,libero_utils}.py: one environment for a task, seeded with
0; before each episode it is reset, then set to the episode's initial state; ten steps of a dummy
action; each step ends the episode when the task is done.

Two things differ without changing any result. The scripts render both cameras in every step; this
class keeps the state of an image and renders it on request. (robosuite 1.4 samples observations
after the first of a control period's 25 physics steps, not at its end; so it is that state.) And an
episode that is not the first of its task draws the random numbers of the resets before it, instead
of resetting the environment that many times.
"""

from __future__ import annotations

import copy
import os
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
from libero.libero import benchmark, get_libero_path
from libero.libero.envs import OffScreenRenderEnv
from robosuite.environments.robot_env import RobotEnv
from robosuite.utils.errors import RandomizationError
from robosuite.utils.observables import sensor

from rn_eval.libero.simulator.pipe import Image, State

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray
    from robosuite.utils.binding_utils import MjSim

DUMMY_ACTION = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)
WAIT_STEPS = 10
SEED = 0
_LOOKS = ("site_rgba", "geom_rgba", "mat_rgba")
"""Colours that tasks change (a glowing burner) after the image of the same step."""


class Snapshots:
    """The state of the simulation at the time of its observation."""

    def __init__(self) -> None:
        self._data: object = None
        self._looks: dict[str, object] = {}

    def take(self, sim: MjSim) -> None:
        """Store the current state."""
        self._data = copy.copy(sim.data._data)
        self._looks = {name: np.array(getattr(sim.model, name)) for name in _LOOKS}

    def render(self, sim: MjSim, camera: str, size: int) -> NDArray[np.uint8]:
        """Render the stored state: uint8 (H, W, 3), the lowest row first."""
        context, model = sim._render_context_offscreen, sim.model
        data, looks = context.data, {name: np.array(getattr(model, name)) for name in _LOOKS}
        context.data = SimpleNamespace(_data=self._data)
        try:
            for name, values in self._looks.items():
                getattr(model, name)[:] = values
            image: NDArray[np.uint8] = sim.render(camera_name=camera, width=size, height=size)
            return image
        finally:
            context.data = data
            for name, values in looks.items():
                getattr(model, name)[:] = values


def _camera_sensors(
    environment: RobotEnv, cam_name: str, *_: object, **__: object
) -> tuple[list[Callable[[object], NDArray[np.float64]]], list[str]]:
    """Replaces `RobotEnv._create_camera_sensors`: the sensor stores the state instead of
    rendering.
    """

    @sensor(modality="image")  # type: ignore[untyped-decorator]
    def keep(cache: object) -> NDArray[np.float64]:
        if cam_name == environment.camera_names[0]:
            environment.snapshots.take(environment.sim)
        return np.zeros(2)

    return [keep], [f"{cam_name}_image"]


class LiberoWorld:
    """An environment with its current episode. Holds one task at a time."""

    def __init__(self) -> None:
        RobotEnv._create_camera_sensors = _camera_sensors
        self._task: tuple[str, int, int] | None = None
        self._env: OffScreenRenderEnv = None  # until open()
        self._states: NDArray[np.float64] = np.empty((0, 0))
        self._instruction = ""
        self._reset_body: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._original_reset: Callable[[], None] = lambda: None
        self._samplers: list[object] = []
        self._snapshots = Snapshots()
        self._observation: Mapping[str, NDArray[np.float64]] = {}

    def open(self, suite: str, task: int, state: int, image_px: int) -> State:
        """Start an episode; return the state after the waiting steps."""
        if self._task != (suite, task, image_px):
            self._load(suite, task, image_px)
        if not 0 <= state < len(self._states):
            raise ValueError(f"initial state {state} of {len(self._states)}")
        self._draw_until(state)
        self._env.reset()
        self._observation = self._env.set_init_state(self._states[state])
        done = False
        for _ in range(WAIT_STEPS):
            self._observation, _, done, _ = self._env.step(DUMMY_ACTION)
        return self._state(bool(done))

    def step(self, action: NDArray[np.float64]) -> State:
        """Run one control period."""
        self._observation, _, done, _ = self._env.step(action.tolist())
        return self._state(bool(done))

    def render(self, camera: str) -> Image:
        """Render the image of the last state."""
        assert self._task is not None
        return Image(pixels=self._snapshots.render(self._env.env.sim, camera, self._task[2]))

    def close(self) -> None:
        """Release the simulator."""
        env, self._env, self._task = self._env, None, None
        if env is not None:
            env.close()

    def _load(self, suite: str, task: int, image_px: int) -> None:
        self.close()
        tasks = benchmark.get_benchmark_dict()[suite]()
        chosen = tasks.get_task(task)
        path = os.path.join(get_libero_path("bddl_files"), chosen.problem_folder, chosen.bddl_file)
        self._states = np.asarray(tasks.get_task_init_states(task))
        self._instruction = chosen.language
        RobotEnv.snapshots = self._snapshots
        self._env = OffScreenRenderEnv(
            bddl_file_name=path, camera_heights=image_px, camera_widths=image_px
        )
        self._samplers = list(self._env.env.object_property_initializers)
        self._task = (suite, task, image_px)
        self._remember_bodies()

    def _remember_bodies(self) -> None:
        """Record the body poses with which a reset begins: fixtures at the model's poses."""
        inner = self._env.env
        original = self._original_reset = inner._reset_internal
        self._reset_body = None

        def remember() -> None:
            model = inner.sim.model
            self._reset_body = (np.array(model.body_pos), np.array(model.body_quat))
            original()

        inner._reset_internal = remember

    def _draw_until(self, episode: int) -> None:
        """Advance the random generator to the scripts' state before reset number `episode`."""
        inner = self._env.env
        # because each reset adds them again
        inner.object_property_initializers[:] = list(self._samplers)
        self._env.seed(SEED)
        if episode and self._reset_body is None:
            self._env.reset()  # one complete reset yields the fixtures' poses before a reset
            episode -= 1
        for _ in range(episode):
            assert self._reset_body is not None
            body_pos, body_quat = self._reset_body
            while True:
                inner.object_property_initializers.extend(self._samplers)
                inner.sim.reset()
                inner.sim.model.body_pos[:], inner.sim.model.body_quat[:] = body_pos, body_quat
                try:
                    self._original_reset()
                except RandomizationError:
                    continue
                break

    def _state(self, is_done: bool) -> State:
        observed = self._observation
        simulated = self._env.env.sim.get_state()
        return State(
            instruction=self._instruction,
            is_done=is_done,
            joints=np.concatenate(
                [observed["robot0_joint_pos"], observed["robot0_gripper_qpos"]]
            ).astype(np.float64),
            eef_pos=np.asarray(observed["robot0_eef_pos"], np.float64),
            eef_quat=np.asarray(observed["robot0_eef_quat"], np.float64),
            flat=np.concatenate([[simulated.time], simulated.qpos, simulated.qvel]).astype(
                np.float64
            ),
        )

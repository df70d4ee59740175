"""Inference: newest images and proprioception in, actions out; chunks are played out here."""

from __future__ import annotations

import logging
import statistics
import threading
import time
from collections import deque
from dataclasses import replace
from typing import cast

from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecyclePublisher
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import Float64MultiArray

from roboneuron.contract import ActionChunk, Backend, CameraProfile, Observation, Runtime
from roboneuron.errors import ConfigurationError, NotReadyError
from roboneuron.modules.inputs import NewestInputs
from roboneuron.modules.instruction import Instruction
from roboneuron.modules.module import Module, ModuleNode
from roboneuron.modules.plugin import build, load_profile
from roboneuron.modules.settings import ACT_FROM, INSTRUCTION_PARAMETER, NEVER_NS, TURN_PARAMETERS
from roboneuron.modules.turn import Turn
from roboneuron.modules.worker import Worker
from roboneuron.planning import check_plan
from roboneuron.plugins.discovery import discover
from roboneuron.ros.messages import to_action_message
from roboneuron.ros.qos import NEWEST
from roboneuron.ros.topics import ACTION, EE_POSE, JOINT_STATES, camera_image, camera_info

_WAIT_S = 0.1
_FIRST_LIMIT_S, _LEAST_LIMIT_S, _LIMIT_RATIO = 5.0, 0.4, 3.0
_RECENT = 20
"""A backend is stalled when it takes three times as long as it usually does; before the first prediction, after 5 s."""
_PACE = 0.8
"""The next inference may start after this share of a step has passed since the last action went out."""
SILENCE_S = 1.0
"""Without a usable observation for this long, inference reports an error (it has stopped acting long before)."""
_SOURCES = {
    "image": ("image", "perception"),
    "joint_state": ("joint state", "the robot"),
    "ee_pose": ("end-effector pose", "control"),
}
log = logging.getLogger(__name__)


class InferenceModule(Module):
    """Runs one backend on the newest observation and publishes its actions one per step."""

    def __init__(self, node: ModuleNode) -> None:
        super().__init__(node)
        self._backend: Backend | None = None
        self._runtime: Runtime | None = None
        self._publisher: LifecyclePublisher | None = None
        self._subscriptions: list[object] = []
        self._inputs: NewestInputs | None = None
        self._worker = Worker("inference", self._step, self.status, limit_s=_FIRST_LIMIT_S)
        self._instruction = Instruction(self.status)
        self._turn = Turn()
        self._next_s = 0.0
        self._shadow_count = 0
        self._took_s: deque[float] = deque(maxlen=_RECENT)
        self._has_acted = False

    def configure(self) -> None:
        """Load the backend (weights and warm-up included), then subscribe to its inputs."""
        config = self.config.inference
        if config is None:
            raise ConfigurationError("The configuration has no [inference] section.")
        registry = discover(self.config.disabled_plugins)
        plan = check_plan(
            registry,
            robot=self.config.robot.name,
            driver=self.config.robot.driver,
            perception=None,
            controller=None,
            backend=config.backend,
            runtime=config.runtime,
            acceleration=config.acceleration,
            cameras=config.cameras,
        )
        profile = load_profile(registry, self.config.robot.name)
        cameras: dict[str, CameraProfile] = {}
        for role, name in plan.cameras.items():
            camera = profile.camera(name)
            if camera is None:
                raise ConfigurationError(f"Robot {profile.name!r} has no camera {name!r} for the role {role!r}.")
            cameras[role] = camera
        spec = plan.backend
        assert spec is not None
        options = dict(self.config.options(spec.name))
        if config.checkpoint is not None:
            options["checkpoint"] = config.checkpoint
        parts = {
            part: None if chosen is None else build(chosen, self.config.options(chosen.name))
            for part, chosen in (("runtime", plan.runtime), ("acceleration", plan.acceleration))
        }
        self._runtime = cast("Runtime | None", parts["runtime"])
        self._backend = cast("Backend", build(spec, options, **parts))
        started_s = time.monotonic()
        self._backend.load()
        self.status.set_value("load_s", time.monotonic() - started_s)
        self.status.set_value("backend", spec.name)
        self.status.set_value("runtime", plan.runtime.name if plan.runtime else "")
        self.status.set_value("acceleration", plan.acceleration.name if plan.acceleration else "")
        self._inputs = NewestInputs(
            cameras=cameras,
            optional=frozenset(spec.optional_cameras),
            needs_state=spec.needs_state,
            gripper=profile.gripper,
            max_age_s=config.max_image_age_s,
            status=self.status,
            now_ns=lambda: int(self.node.get_clock().now().nanoseconds),
        )
        self._subscribe(self._inputs)
        self._publisher = self.node.create_lifecycle_publisher(Float64MultiArray, ACTION, NEWEST)
        self._declare_parameters(config.instruction)

    def activate(self) -> None:
        """Start acting on the instruction, when there is one."""
        assert self._inputs is not None
        self._inputs.check_types(dict(self.node.get_topic_names_and_types()), self.node.get_namespace())
        self._instruction.restart()
        self._next_s = 0.0
        self.status.set_waiting(self._inputs.missing() or "the first action")
        self._worker.start()

    def deactivate(self) -> None:
        """Stop publishing at once; a prediction in progress is given up, or thrown away."""
        if not self._worker.stop(give_up=self._give_up):
            raise NotReadyError("The backend hangs in predict(); its process must be ended.")

    def close(self) -> None:
        """Release the backend and the topics."""
        self._worker.stop(give_up=self._give_up)
        if self._backend is not None:
            self._backend.close()
            self._backend = self._runtime = None
        for subscription in self._subscriptions:
            self.node.destroy_subscription(subscription)
        self._subscriptions.clear()
        if self._publisher is not None:
            self.node.destroy_lifecycle_publisher(self._publisher)
            self._publisher = None

    def _give_up(self) -> None:
        """End a prediction that a runtime works on, so that no server goes on with what nobody wants."""
        if self._runtime is None:
            return
        try:
            self._runtime.abort()
        except Exception:  # the module border: silence matters more than what a plugin says about it
            log.exception("the runtime could not give up its prediction")

    def _subscribe(self, inputs: NewestInputs) -> None:
        for role, camera in inputs.cameras.items():
            self._subscriptions += [
                self.node.create_subscription(
                    CameraInfo, camera_info(camera.name), inputs.camera_info_callback(role), NEWEST
                ),
                self.node.create_subscription(Image, camera_image(camera.name), inputs.image_callback(role), NEWEST),
            ]
        if inputs.needs_state:
            self._subscriptions += [
                self.node.create_subscription(JointState, JOINT_STATES, inputs.on_joint_state, NEWEST),
                self.node.create_subscription(PoseStamped, EE_POSE, inputs.on_ee_pose, NEWEST),
            ]

    def _declare_parameters(self, instruction: str) -> None:
        if not self.node.has_parameter(INSTRUCTION_PARAMETER):
            self.node.add_on_set_parameters_callback(self._on_parameters)
            for name in TURN_PARAMETERS:
                self.node.declare_parameter(name, NEVER_NS if self.settings.shadow and name == ACT_FROM else 0)
            self.node.declare_parameter(INSTRUCTION_PARAMETER, instruction)
        else:
            self.node.set_parameters([Parameter(INSTRUCTION_PARAMETER, value=instruction)])

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Take all of them or none."""
        turns = [p for p in parameters if p.name in TURN_PARAMETERS]
        instructions = [p for p in parameters if p.name == INSTRUCTION_PARAMETER]
        reasons = [self._turn.check(p) for p in turns] + [self._instruction.check(p) for p in instructions]
        refused = next((reason for reason in reasons if reason), "")
        if refused:
            return SetParametersResult(successful=False, reason=refused)
        self._turn.set(turns)
        for parameter in instructions:
            self._instruction.set(str(parameter.value))
        return SetParametersResult(successful=True)

    def _step(self, stop: threading.Event) -> None:
        assert self._inputs is not None
        remaining_s = self._next_s - time.monotonic()
        if remaining_s > 0 and stop.wait(remaining_s):
            return
        observation = self._inputs.wait(_WAIT_S)
        if observation is None:
            missing = self._inputs.missing()
            if missing:
                self.status.set_waiting(missing)
            elif self._inputs.silence_s() > SILENCE_S:
                what, source = _SOURCES[self._inputs.unusable()]
                raise NotReadyError(
                    f"No usable {what} for {self._inputs.silence_s():.1f} s; actions have stopped.",
                    hint=f"Is {source} running, and is its clock right?",
                )
            return
        if self._turn.is_over(self._inputs.captured_ns(observation)):
            self.status.set(note="handed over to the successor")
            return
        self._act(observation, stop)

    def _act(self, observation: Observation, stop: threading.Event) -> None:
        """Predict, and publish unless this module works in shadow."""
        assert self._backend is not None
        assert self._inputs is not None
        count, instruction = self._instruction.count, self._instruction.text
        if not instruction:
            self.status.set(note="waiting for an instruction")
            self.status.set_ready()
            return
        if self._instruction.is_new:
            self._instruction.is_new = False
            self._backend.reset()
        started_s = time.monotonic()
        chunk = self._backend.predict(replace(observation, instruction=instruction))
        took_s = time.monotonic() - started_s
        self.status.set_value("inference_ms", took_s * 1e3)
        self._took_s.append(took_s)
        self._worker.limit_s = max(_LEAST_LIMIT_S, _LIMIT_RATIO * statistics.median(self._took_s), 2.0 * chunk.step_s)
        self._worker.progress()
        for name, value in chunk.metrics.items():
            self.status.set_value(f"backend.{name}", float(value))
        self._check_age(observation, took_s)
        if not self._turn.is_shadow(self._inputs.captured_ns(observation)):
            self.status.set(note=chunk.note)
            self._play(chunk, observation, count, stop)
            return
        self.status.set(note="in shadow")
        self.status.set_value("shadow_action", ",".join(f"{value:.5g}" for value in chunk.actions[0]))
        self._shadow_count += 1
        self.status.set_value("shadow_count", self._shadow_count)
        self._note_first(observation)

    def _check_age(self, observation: Observation, took_s: float) -> None:
        """Raise NotReadyError for an answer to an image that has become too old to act on meanwhile."""
        assert self._inputs is not None
        age_s = self._inputs.age_s(observation)
        if age_s <= self._inputs.max_age_s:
            return
        self.status.dropped.add("late_action")
        raise NotReadyError(
            f"The backend answered after {took_s:.2f} s, to an image that was {age_s:.2f} s old by then; "
            f"max_image_age_s = {self._inputs.max_age_s:g} are allowed, so nothing was published.",
            hint="Make the backend faster, or allow older images under [inference].",
        )

    def _note_first(self, observation: Observation) -> None:
        """The first action of a chunk is out, or would be: measure, and that is the proof of readiness."""
        assert self._inputs is not None
        age_ms = self._inputs.age_s(observation) * 1e3
        self.status.latency.add(age_ms)
        self.status.set_value("image_age_ms", age_ms)
        self.status.clear_error()
        self.status.set_ready()

    def _note_turn(self) -> None:
        """Tell when the first action of all goes out: by that a change-over is confirmed and measured."""
        if not self._has_acted:
            self._has_acted = True
            self.status.set_value("first_action_ns", time.time_ns())
            self.status.changed.set()

    def _play(self, chunk: ActionChunk, observation: Observation, count: int, stop: threading.Event) -> None:
        """Publish one action per `step_s`; a new instruction, a successor or the end of activity cuts the chunk."""
        assert self._publisher is not None
        start_s = time.monotonic()
        horizon = len(chunk.actions)
        for index, vector in enumerate(chunk.actions):
            delay_s = start_s + index * chunk.step_s - time.monotonic()
            if delay_s > 0:
                stop.wait(delay_s)
            if stop.is_set() or self._instruction.count != count or self.node.stopped:
                return
            if self._turn.must_fall_silent(int(self.node.get_clock().now().nanoseconds)):
                return
            self._note_turn()
            self._publisher.publish(to_action_message(vector))
            self._worker.progress()
            self.status.output.tick()
            self._instruction.note_action()
            if index == 0:
                self._note_first(observation)
            self.status.set_value("chunk_position", f"{index + 1}/{horizon}")
        self._next_s = time.monotonic() + _PACE * chunk.step_s

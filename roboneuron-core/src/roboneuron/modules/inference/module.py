"""Inference module: from the newest images and proprioception to actions, one for each step of the
backend's chunks.
"""

from __future__ import annotations

import logging
import statistics
import threading
import time
from collections import deque
from dataclasses import replace
from functools import partial

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import Float64MultiArray

from roboneuron.contract import ActionChunk, CameraProfile, ControlSpace, Observation
from roboneuron.errors import ConfigurationError, NotReadyError
from roboneuron.modules.inference.execution import Bounds, Prediction, Row, executor_of
from roboneuron.modules.inference.fallback import FallbackPolicies
from roboneuron.modules.inference.inputs import NewestInputs
from roboneuron.modules.inference.instruction import Instruction
from roboneuron.modules.inference.loaded import load_policy, resolved_cameras
from roboneuron.modules.inference.planning import find_policies
from roboneuron.modules.inference.player import RowPlayer
from roboneuron.modules.inference.polled import PolledSubscriptions
from roboneuron.modules.module_host import Module, ModuleHost
from roboneuron.modules.plugin import load_profile
from roboneuron.modules.predictions import AnsweredPrediction, PredictionRequest
from roboneuron.modules.worker import Worker
from roboneuron.moved import Moved
from roboneuron.ros import messages, topics

_WAIT_S = 0.1
"""Longest wait for an image or for a wanted prediction; bounds the delay of a stop."""
_FIRST_LIMIT_S, _LEAST_LIMIT_S, _LIMIT_RATIO = 5.0, 0.4, 3.0
_RECENT = 20
"""Number of predictions for the usual time. A backend counts as stalled after three times that;
before the first prediction, after 5 s.
"""
SILENCE_S = 1.0
"""Time without a usable observation after which inference reports an error (actions have stopped
long before).
"""
_SOURCES = {
    "image": ("image", "perception"),
    "joint_state": ("joint state", "the robot"),
    "ee_pose": ("end-effector pose", "control"),
}
log = logging.getLogger(__name__)


class InferenceModule(Module):
    """Runs one backend on the newest observation, and publishes its actions one per step.

    It has two threads: one observes and predicts, one plays (`RowPlayer`). `ChunkExecutor` decides
    what each does when. With a fallback, the first policy has a third thread (`FallbackPolicies`).

    Attributes:
        backend, runtime: the backend, and its runtime or None.
        executor: decides when to predict and what to send.
    """

    accepts, deliver = Moved("StepFilter.admits"), Moved("StepFilter.deliver")
    before_prediction, on_prediction = Moved("StepFilter.prepare"), Moved("StepFilter.note_answer")

    def __init__(self, node: ModuleHost) -> None:
        """Load the backend (weights and warm-up included), then subscribe to its inputs.

        Raises:
            ConfigurationError: there is no [inference] section, the robot has no such camera, or
                chunks cannot be executed as configured.
            PlanningError: backend, runtime, acceleration and robot are incompatible.
            RoboNeuronError: the backend cannot be loaded.
        """
        super().__init__(node)
        config, robot = self.config.inference, self.config.robot
        if config is None:
            raise ConfigurationError("The configuration has no [inference] section.")
        policy, second = find_policies(self.config, self.registry, in_module=True)
        profile = load_profile(self.registry, robot)
        both = [policy] if second is None else [policy, second]
        cameras = resolved_cameras(both, profile)
        options = dict(self.config.options(policy.backend.name))
        if config.checkpoint is not None:
            options["checkpoint"] = config.checkpoint
        self._policy = load_policy(self.config, self.registry, policy, options, node.resources)
        self.backend, self.runtime = self._policy.backend, self._policy.runtime
        self._policy.report(self.status)
        self._took_s: deque[float] = deque(maxlen=_RECENT)
        # read by the predicting thread: passing each image on to it took longer than all other work
        self._images = PolledSubscriptions(node)
        needs_state = any(one.backend.needs_state for one in both)
        needed = {role for one in both for role in one.backend.cameras}
        self._inputs = NewestInputs(
            cameras=cameras,
            optional=frozenset(cameras.keys() - needed),
            needs_state=needs_state,
            gripper=profile.gripper,
            arms=profile.arms,
            max_age_s=config.max_image_age_s,
            status=self.status,
            now_ns=node.now_ns,
            take_images=self._images.take,
        )
        self._subscribe(cameras, with_state=needs_state)
        self._actions = node.advertise(Float64MultiArray, topics.ACTION)
        bounds = Bounds(first_s=config.max_image_age_s, tail_s=config.max_tail_age_s)
        self.executor = executor_of(
            self.filters, self._policy.policy.backend, config.execution, bounds
        )
        self._not_before_ns = 0
        self._is_blind = False
        self._worker = Worker("inference", self._step, self.status, limit_s=_FIRST_LIMIT_S)
        node.resources.callback(self._worker.stop, give_up=self._give_up)
        if second is not None:
            standin = load_policy(
                self.config,
                self.registry,
                second,
                self.config.options(second.backend.name),
                node.resources,
            )
            fallback = FallbackPolicies.beside(
                self._policy, standin, self.executor, self.config, self.status
            )
            fallback.on_wait = self._worker.progress
            node.resources.callback(fallback.close)
            self.filters.add(fallback)
        self._instruction = Instruction(node, config.instruction, self.executor.begin_epoch)
        self._player = RowPlayer(node, self.filters, self.executor, self._send)

    @property
    def space(self) -> ControlSpace:
        """Space of the published rows."""
        return self._policy.agreement.executed

    def activate(self) -> None:
        """Start acting on the instruction, if there is one.

        Raises:
            ConfigurationError: images of another type are published on the backend's topics.
        """
        self._inputs.check_types(
            dict(self.node.get_topic_names_and_types()), self.node.get_namespace()
        )
        self._instruction.restart()
        self.executor.begin_epoch()
        self.status.set_waiting(self._inputs.missing() or "the first action")
        self._player.start()
        self._worker.start()

    def deactivate(self) -> None:
        """Stop publishing at once; a prediction in progress is cancelled or discarded.

        Raises:
            NotReadyError: the backend hangs, and its thread cannot be ended.
        """
        self.executor.begin_epoch()
        self._player.stop()
        if not self._worker.stop(give_up=self._give_up):
            raise NotReadyError("The backend hangs in predict(); its process must be ended.")

    def emergency_stop(self, latched: bool) -> None:
        """Discard the plan. After a release, a new instruction is based on later images."""
        # also for a release: images captured during the stop show a robot at rest
        self._not_before_ns = self.node.now_ns()
        self.executor.begin_epoch()

    def stop(self, code: str) -> None:
        """See `Module.stop`: after a stop, the policy needs a new instruction."""
        self._instruction.forget()

    def _give_up(self) -> None:
        """Cancel a prediction in the runtime, so that a server does not continue with a useless
        request.
        """
        if self.runtime is None:
            return
        try:
            self.runtime.abort()
        # the module border: the stop matters more than a plugin's error
        except Exception:
            log.exception("the runtime could not give up its prediction")

    def _subscribe(self, cameras: dict[str, CameraProfile], *, with_state: bool) -> None:
        for role, camera in cameras.items():
            take_info = partial(self._inputs.on_camera_info, role)
            self.node.subscribe(
                CameraInfo, topics.camera_info(camera.name), take_info, group=self._images
            )
            take_image = partial(self._inputs.on_image, role)
            self.node.subscribe(
                Image, topics.camera_image(camera.name), take_image, group=self._images
            )
        if with_state:
            self.node.subscribe(JointState, topics.JOINT_STATES, self._inputs.on_joint_state)
            self.node.subscribe(PoseStamped, topics.EE_POSE, self._inputs.on_ee_pose)
            for arm in self._inputs.arms:
                topic, take = (
                    f"{arm.name}/{topics.EE_POSE}",
                    partial(self._inputs.on_arm_pose, arm.name),
                )
                self.node.subscribe(PoseStamped, topic, take)

    def _step(self, stop: threading.Event) -> None:
        """Observe and predict once, if a prediction is wanted."""
        for one in self.filters:
            one.prepare()
        if not self.executor.wait_until_wanted(stop, _WAIT_S):
            return
        observation = self._observe()
        if observation is None:
            return
        captured_ns = self._inputs.captured_ns(observation)
        # before a stop, or not for this module
        if captured_ns < self._not_before_ns or not self.filters.admits(captured_ns):
            return
        if not self.executor.admits(observation):
            return
        count, instruction = self._instruction.count, self._instruction.text
        if not instruction:
            since = f" after a stop ({self.node.needs_start})" if self.node.needs_start else ""
            self.status.set(note=f"waiting for an instruction{since}")
            # during a stop too: a module started then has passed all possible checks
            self.status.set_ready()
            return
        if self.node.stopped:  # the request from before the stop is being discarded
            stop.wait(_WAIT_S)
            return
        instructed = replace(observation, instruction=instruction)
        prediction = self.executor.begin(instructed, captured_ns)
        # changed meanwhile: the epoch may be that of the next one
        if self._instruction.count != count:
            return
        try:
            answered = self._predict(prediction, instructed, stop)
        except Exception:
            if self._instruction.count == count:
                raise
            # of an instruction that was replaced meanwhile: no error of the present one
            log.info("The answer to an earlier instruction failed", exc_info=True)
            self.status.drop("withdrawn_chunk")
            return
        if answered is None:
            return
        answer, took_s = answered
        try:
            self.filters.deliver(answer, self._deliver)
        finally:
            # after the action was sent: reporting all this takes as long as publishing it
            self._note_prediction(answer.chunk, took_s)

    def _deliver(self, answer: AnsweredPrediction) -> None:
        with self.executor.changed:  # so that the player's thread does not run in between
            outcome = self.executor.answer(answer.prediction, answer.chunk, self.node.now_ns())
            self._player.play_due(answer.stop)
        self.status.set(note=answer.chunk.note)
        if outcome != "accepted":
            self.status.drop(f"{outcome}_chunk")

    def _observe(self) -> Observation | None:
        """Return the newest observation, without its instruction; None if there is none to act on
        now.

        Raises:
            NotReadyError: there was none for `SILENCE_S`; actions have stopped long before.
        """
        observation = self._inputs.wait(_WAIT_S)
        if observation is None:
            missing = self._inputs.missing()
            if missing:
                self.status.set_waiting(missing)
            elif self._inputs.silence_s() > SILENCE_S:
                what, source = _SOURCES[self._inputs.unusable()]
                self._is_blind = True
                raise NotReadyError(
                    f"No usable {what} for {self._inputs.silence_s():.1f} s; actions have stopped.",
                    hint=f"Is {source} running, and is its clock right?",
                )
        elif self._is_blind:  # without an instruction no action follows that would clear the error
            self._is_blind = False
            self.status.clear_error()
        return observation

    def _predict(
        self, prediction: Prediction, measured: Observation, stop: threading.Event
    ) -> tuple[AnsweredPrediction, float] | None:
        """Run the policy; return its answer, and the time it took [s]. None if there was none in
        time: the next image follows.

        An exception of the backend is reported unchanged, after the rows of earlier answers were
        dropped.
        """
        resets = self._instruction.is_new
        self._instruction.is_new = False
        started_s = time.monotonic()
        try:
            request = PredictionRequest(
                prediction=prediction, measured=measured, resets=resets, stop=stop
            )
            answer = self.filters.predict(request, self._ask_policy)
        except Exception as error:
            self._notify(prediction, resets, error)
            # earlier rows must not continue when the newest image is refused
            self.executor.drop()
            raise
        if answer is None:
            return None
        took_s = time.monotonic() - started_s
        # before its actions: a recording needs this order
        self._notify(answer.prediction, resets, answer.chunk)
        return answer, took_s

    def _ask_policy(self, request: PredictionRequest) -> AnsweredPrediction:
        if request.resets:
            self.backend.reset()
        chunk = self._policy.answer(self.executor.as_seen(request.prediction.observation))
        return AnsweredPrediction(prediction=request.prediction, chunk=chunk, stop=request.stop)

    def _note_prediction(self, chunk: ActionChunk, took_s: float) -> None:
        """Report an answer in the status.

        The time after which the thread counts as stalled depends on the predictions: at least 0.4
        s, three times their median, or two steps.
        """
        self._took_s.append(took_s)
        self._worker.limit_s = max(
            _LEAST_LIMIT_S, _LIMIT_RATIO * statistics.median(self._took_s), 2.0 * chunk.step_s
        )
        self._worker.progress()
        self.status.set_value("inference_ms", took_s * 1e3)
        for name, value in chunk.metrics.items():
            self.status.set_value(f"backend.{name}", float(value))
        # the execution mode, and the numbers that decided
        for name, executed in self.executor.values().items():
            self.status.set_value(f"execution.{name}", executed)

    def _notify(
        self, prediction: Prediction, resets: bool, answer: ActionChunk | Exception
    ) -> None:
        for one in self.filters:
            one.note_answer(prediction, resets, answer)

    def _send(self, row: Row) -> None:
        """Publish one row and the rows planned after it; called by the player, which holds the
        executor's lock.
        """
        message = messages.to_action_message(row.vector, self.space, self._planned_after(row))
        self._actions.publish(message)
        self.status.output.tick()
        self._instruction.note_action()
        if row.is_border:
            self.note_first(row.oldest_ns)
        self.status.set_value("chunk_row", row.index + 1)
        self.status.set_value("chunk_rows", row.horizon)

    def _planned_after(self, row: Row) -> messages.PlannedRows | None:
        """Rows that follow `row` within the horizon of control."""
        control = self.config.control
        if control is None or not (control.horizon_s and self.space.is_absolute):
            return None
        vectors = self.executor.planned(row.step_s, control.horizon_s)
        if not vectors:
            return None
        return messages.PlannedRows(rows=np.array(vectors), step_s=row.step_s)

    def note_first(self, oldest_ns: int) -> None:
        """Record that the first action of a chunk was sent, or would have been: update the latency
        and report readiness.
        """
        age_ms = (self.node.now_ns() - oldest_ns) / 1e6
        self.status.latency.append(age_ms)
        self.status.set_value("image_age_ms", age_ms)
        self.status.clear_error()
        self.status.set_ready()

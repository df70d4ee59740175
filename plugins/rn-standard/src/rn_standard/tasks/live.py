"""The robot of a task: the closed loop of this server, and its published topics."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

from rn_standard.tasks.snapshot import ArmSnapshot, Snapshot, StillClock
from rn_standard.tasks.task_robot import PolicyState
from rn_standard.tasks.task_time import TaskTime, TimesTasks
from rn_standard.teleoperation.feature import TELEOPERATION, Teleoperation
from roboneuron import (
    ConfigurationError,
    Frame,
    Host,
    InvalidInputError,
    NotReadyError,
    Picture,
    RobotProfile,
)
from roboneuron.feature import ModuleKind, ModuleView, Report, Stage
from roboneuron.selection.requests import StartChosenInference
from roboneuron.sight.inputs import Inputs
from roboneuron.sight.marks import marked

_TOLD_S = 5.0
_IMAGES_S = 3.0
_DONE = ("backend.done", "done")


class LiveCell:
    """Implementation of `TaskRobot` on the server's robot.

    Args:
        host: the server.
        profile: profile of the robot; None without a plugin.
        role: role of the caller.
        stage: called with the progress of a start of the policy.
        halt: set when the task has to end.
        why: returns the reason of the end; empty for the caller's cancellation.
        topics: type by topic, for those in predicates.
        cameras: names of the cameras that predicates or evidence need.
    """

    def __init__(
        self,
        host: Host,
        profile: RobotProfile | None,
        role: str,
        stage: Stage,
        halt: threading.Event,
        why: Callable[[], str],
        topics: Mapping[str, str],
        cameras: Iterable[str],
    ) -> None:
        self._host = host
        self._profile = profile
        self._arms = {arm.name: arm for arm in (() if profile is None else profile.arms)}
        self._role = role
        self._stage = stage
        self._halt = halt
        self._why = why
        self._starts = host.loop.starts
        # of the request: a stop before the task begins ends it too
        self._arm_stops = self._starts.arm_stops
        self._topics = dict(topics)
        self._cameras = list(cameras)
        clock = host.clock(host.config.namespace)
        self._time = (
            clock.task_time(halt, lambda: bool(self._lost()))
            if isinstance(clock, TimesTasks)
            else TaskTime(halt)
        )
        self._inputs = Inputs(host, age_factor=self._time.age_factor)
        self._still = StillClock(kinds=None if profile is None else profile.kinds)
        self._instruction = ""
        self._last_word: bool | None = None
        self._count = self._errors = self._ticket = 0
        self._pid: int | None = None
        self._stops: int | None = None
        self._needed: tuple[ModuleKind, ...] = ()

    def open(self) -> None:
        """Subscribe to the required topics; waits briefly for the cameras' first images.

        Raises:
            InvalidInputError: a topic of a predicate is used here with another type.
            RoboNeuronError: ROS cannot be joined, or a topic's type is not installed.
        """
        self._time.open()
        space = self._host.config.namespace
        self._inputs.open(f"/{space}/joint_states", "sensor_msgs/msg/JointState")
        for arm in ("", *self._arms):
            self._inputs.open(self._inputs.pose_topic(arm), "geometry_msgs/msg/PoseStamped")
        for topic, type_name in self._topics.items():
            try:
                self._inputs.open(topic, type_name)
            except ConfigurationError as error:  # for the agent it is an argument
                raise InvalidInputError(
                    f"until: {error.message}", hint=error.hint, path="until"
                ) from error
        for camera in self._cameras:
            self._inputs.open_camera(self._inputs.image_topic(camera))
        wanted = [self._inputs.image_topic(camera) for camera in self._cameras]
        deadline_s = time.monotonic() + _IMAGES_S
        while time.monotonic() < deadline_s and any(
            self._inputs.last(topic) is None for topic in wanted
        ):
            if self._halt.wait(0.02):
                return

    def close(self) -> None:
        """Unsubscribe; idempotent."""
        self._inputs.close()

    def now_s(self) -> float:
        """See `TaskRobot`."""
        return self._time.now_s()

    def wait(self, seconds: float) -> bool:
        """See `TaskRobot`."""
        return self._time.wait(seconds)

    def begin(self, instruction: str) -> None:
        """See `TaskRobot`. If no backend runs, it is started, and waits for the instruction.

        Raises:
            StateError: there was a stop since the task has begun; motion needs a new start.
        """
        self._time.hold_policy()
        self._give(instruction)
        self._time.let_policy_act()

    def _give(self, instruction: str) -> None:
        self._host.loop.emergency_stop.check()
        if self._stops is None:
            self._stops = self._starts.permit(self._arm_stops)
        if self._host.modules.view("inference").phase != "running":
            self._start_policy()
        self._starts.check(self._stops)
        view = self._host.modules.require_running("inference")
        report = view.report
        self._count = report.instruction_count if report is not None else 0
        self._errors = report.error_count if report is not None else 0
        self._pid = view.process.pid if view.process is not None else None
        self._needed = tuple(
            view.kind for view in self._host.modules.views() if view.phase == "running"
        )
        if self._halt.is_set():
            return
        self._instruction, self._last_word = instruction, None
        self._ticket, refused = self._starts.give(instruction, _TOLD_S)
        if refused:
            raise InvalidInputError(
                f"The backend refused the instruction: {refused}.", path="instruction"
            )

    def _start_policy(self) -> None:
        """Start the policy without the configured instruction, which was not requested."""
        loop = self._host.loop
        plan = loop.select("inference", StartChosenInference(options={}), self._role)
        section = plan.config.inference
        assert section is not None
        section = section.model_copy(update={"instruction": ""})
        config = plan.config.model_copy(update={"inference": section})
        loop.start_selected(replace(plan, config=config), self._stage, self._halt)
        self._time.hold_policy()

    def policy(self) -> PolicyState:
        """See `TaskRobot`."""
        if self._host.loop.emergency_stop.is_latched():
            cause = self._host.loop.emergency_stop.cause()
            return PolicyState(
                has_acted=False,
                taken=f"the emergency stop is latched{f' ({cause})' if cause else ''}",
            )
        if taken := self._why() or self._lost():
            return PolicyState(has_acted=False, taken=taken)
        led = self._led()
        view = self._host.modules.view("inference")
        report = self._report_of_this(view)
        if report is None:
            return PolicyState(has_acted=False, led=led)
        errors = self._errors if self._is_same(view) else 0
        failure = report.failure() if report.error_count > errors else None
        told = "" if failure is None or isinstance(failure, NotReadyError) else str(failure)
        return PolicyState(has_acted=report.actions_for_instruction > 0, failure=told, led=led)

    def _led(self) -> str:
        """Name of the person who leads the arm by hand while the policy waits; empty for none."""
        feature = self._host.features.loaded.get(TELEOPERATION)
        lead = feature.lead if isinstance(feature, Teleoperation) else None
        return lead.who if lead is not None and lead.session.mode == "person" else ""

    def _lost(self) -> str:
        """Describe the module that the task has lost, or the end of its instruction; empty if it
        has all it needs.
        """
        if self._stops is None:
            return ""
        for view in map(self._host.modules.view, self._needed):
            if loss := view.loss():
                return f"{view.kind} {loss}"
            if view.phase != "running":
                return f"{view.kind} was stopped (it is {view.phase})"
        if self._starts.stops != self._stops:
            return f"there was a stop: {self._starts.reason}"
        if self._instruction and self._starts.ticket != self._ticket:
            return f"another client gave the instruction {self._starts.instruction!r}"
        return ""

    def look(self) -> Snapshot:
        """See `TaskRobot`."""
        space = self._host.config.namespace
        poses = [self._inputs.pose_topic(arm) for arm in ("", *self._arms)]
        images = [self._inputs.image_topic(camera) for camera in self._cameras]
        self._time.await_measured(
            self._inputs,
            {"robot": [f"/{space}/joint_states"], "control": poses, "perception": images},
        )
        now_s = self.now_s()
        message = self._inputs.newest(f"/{space}/joint_states")
        joints: dict[str, float] | None = None
        effort: dict[str, float] = {}
        if message is not None:
            joints = {
                str(name): float(value)
                for name, value in zip(message.name, message.position, strict=False)
            }
            effort = {
                str(name): float(value)
                for name, value in zip(message.name, message.effort, strict=False)
            }
        gripper = self._profile.gripper if self._profile is not None else None
        return Snapshot(
            now_s=now_s,
            joints=joints,
            effort=effort,
            tcp=self._inputs.pose(""),
            gripper_open=None if gripper is None else gripper.opening_in(joints),
            arms={
                name: ArmSnapshot(
                    tcp=self._inputs.pose(name),
                    gripper_open=arm.opening_in(joints),
                )
                for name, arm in self._arms.items()
            },
            still_s=None if joints is None else self._still.observe(now_s, joints),
            policy_done=self._done(),
            frames=self._frames(),
            messages={topic: self._inputs.last(topic) for topic in self._topics},
        )

    def end(self) -> None:
        """See `TaskRobot`: the instruction is withdrawn from every process; one that keeps it is
        ended.
        """
        if self._instruction:
            self._last_word = self._done()
            self._instruction = ""
            self._starts.withdraw(self._ticket)
        self._time.end()

    def evidence(self, when: str) -> tuple[Picture, ...]:
        """See `TaskRobot`."""
        frames = [frame for camera in self._cameras if (frame := self._frame(camera)) is not None]
        return tuple(marked(frame, {}, f"{frame.camera} {when}") for frame in frames)

    def _report_of_this(self, view: ModuleView) -> Report | None:
        """The newest report, once it is about the last instruction; also of a policy switched to
        since.
        """
        report = view.report
        if report is None or report.instruction != self._instruction:
            return None
        return report if report.instruction_count > self._count or not self._is_same(view) else None

    def _is_same(self, view: ModuleView) -> bool:
        """True if the policy is the process that received the instruction."""
        return view.process is not None and view.process.pid == self._pid

    def _done(self) -> bool | None:
        if not self._instruction:
            return self._last_word
        report = self._report_of_this(self._host.modules.view("inference"))
        if report is None or report.actions_for_instruction == 0:
            return None
        said = next((report.metrics[name] for name in _DONE if name in report.metrics), "")
        try:
            return float(said) >= 0.5 if said else None
        except ValueError:
            return None

    def _frames(self) -> dict[str, Frame]:
        roles = self._host.loop.camera_roles()
        found = {roles.get(camera, camera): self._frame(camera) for camera in self._cameras}
        return {role: frame for role, frame in found.items() if frame is not None}

    def _frame(self, camera: str) -> Frame | None:
        return self._inputs.frame(self._inputs.image_topic(camera), camera, self._profile)

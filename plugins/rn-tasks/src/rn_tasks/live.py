"""The robot of a task: the closed loop of this server, and what it publishes."""

from __future__ import annotations

import io
import logging
import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress

from rn_selection.requests import StartInference
from rn_tasks.inputs import Inputs, pose_of
from rn_tasks.runner import PolicyState
from rn_tasks.snapshot import Snapshot, StillClock
from roboneuron import Frame, RobotProfile
from roboneuron.errors import InvalidInputError, NotReadyError, RefusedError, RoboNeuronError, StateError
from roboneuron.modules.settings import INSTRUCTION_PARAMETER
from roboneuron.server.host import Host
from roboneuron.server.tool import Picture, Stage
from roboneuron.supervisor.health import ModuleView, Report

log = logging.getLogger(__name__)
_TOLD_S = 5.0
_END_S = 1.0
"""Longest wait for the policy to be told to end; after that its process is."""
_IMAGES_S = 3.0
_QUALITY = 85
_DONE = ("backend.done", "done")


class LiveCell:
    """Follows the protocol `Cell`.

    Args:
        host: the server.
        profile: of the robot; None for one that no plugin describes.
        role: of the caller.
        stage: told how a start of the policy goes.
        halt: set when the task is to end.
        topics: type by topic, of those that predicates name.
        cameras: names of the cameras that predicates or evidence need.
    """

    def __init__(
        self,
        host: Host,
        profile: RobotProfile | None,
        role: str,
        stage: Stage,
        halt: threading.Event,
        topics: Mapping[str, str],
        cameras: Iterable[str],
    ) -> None:
        self._host = host
        self._profile = profile
        self._role = role
        self._stage = stage
        self._halt = halt
        self._topics = dict(topics)
        self._cameras = list(cameras)
        self._inputs = Inputs(host)
        self._still = StillClock()
        self._instruction = ""
        self._count = self._errors = 0
        self._starting = False

    def open(self) -> None:
        """Listen to what is needed; waits a moment for the cameras' first images.

        Raises:
            RoboNeuronError: ROS cannot be joined, or a topic's type is not installed.
        """
        space = self._host.config.namespace
        self._inputs.open(f"/{space}/joint_states", "sensor_msgs/msg/JointState")
        self._inputs.open(f"/{space}/ee_pose", "geometry_msgs/msg/PoseStamped")
        for topic, type_name in self._topics.items():
            self._inputs.open(topic, type_name)
        for camera in self._cameras:
            self._inputs.open(self._image_topic(camera), "sensor_msgs/msg/Image")
        wanted = [self._image_topic(camera) for camera in self._cameras]
        deadline_s = time.monotonic() + _IMAGES_S
        while time.monotonic() < deadline_s and any(self._inputs.last(topic) is None for topic in wanted):
            if self._halt.wait(0.02):
                return

    def close(self) -> None:
        """Listen no more; idempotent."""
        self._inputs.close()

    def now_s(self) -> float:
        """See `Cell`."""
        return time.monotonic()

    def wait(self, seconds: float) -> bool:
        """See `Cell`."""
        return self._halt.wait(seconds)

    def begin(self, instruction: str) -> None:
        """See `Cell`. A backend that does not run is started."""
        self._check_not_latched()
        if self._host.supervisor.view("inference").phase != "running":
            self._starting = True
            try:
                self._host.loop.start("inference", StartInference(options={}), self._stage, self._role)
            finally:
                self._starting = False
        view = self._host.supervisor.require_running("inference")
        report = view.report
        self._count = report.instruction_count if report is not None else 0
        self._errors = report.error_count if report is not None else 0
        self._instruction = instruction
        if self._halt.is_set():
            return
        refused = self._set(view, instruction, _TOLD_S)
        if refused:
            raise InvalidInputError(f"The backend refused the instruction: {refused}.", path="instruction")

    def cancel(self) -> None:
        """End a start of the policy that `begin` waits for; callable from any thread, returns at once."""
        if self._starting:
            self._host.loop.cancel("inference")

    def policy(self) -> PolicyState:
        """See `Cell`."""
        if self._host.loop.emergency_stop.is_latched():
            cause = self._host.loop.emergency_stop.cause()
            return PolicyState(has_acted=False, taken=f"the emergency stop is latched{f' ({cause})' if cause else ''}")
        view = self._host.supervisor.view("inference")
        if view.phase != "running":
            return PolicyState(has_acted=False, taken=f"the policy does not run any more (it is {view.phase})")
        report = self._report_of_this(view)
        if report is None:
            return PolicyState(has_acted=False)
        if report.instruction != self._instruction:
            return PolicyState(has_acted=False, taken=f"somebody else gave the instruction {report.instruction!r}")
        failure = report.failure() if report.error_count > self._errors else None
        told = "" if failure is None or isinstance(failure, NotReadyError) else str(failure)
        return PolicyState(has_acted=report.actions_for_instruction > 0, failure=told)

    def look(self) -> Snapshot:
        """See `Cell`."""
        space, now_s = self._host.config.namespace, time.monotonic()
        message = self._inputs.newest(f"/{space}/joint_states")
        joints: dict[str, float] | None = None
        effort: dict[str, float] = {}
        if message is not None:
            joints = {str(name): float(value) for name, value in zip(message.name, message.position, strict=False)}
            effort = {str(name): float(value) for name, value in zip(message.name, message.effort, strict=False)}
        gripper = self._profile.gripper if self._profile is not None else None
        opening = None
        if gripper is not None and joints is not None and gripper.joint in joints:
            opening = gripper.to_opening(joints[gripper.joint])
        return Snapshot(
            now_s=now_s,
            joints=joints,
            effort=effort,
            tcp=pose_of(self._inputs.newest(f"/{space}/ee_pose")),
            gripper_open=opening,
            still_s=None if joints is None else self._still.observe(now_s, joints),
            policy_done=self._done(),
            frames=self._frames(),
            messages={topic: self._inputs.last(topic) for topic in self._topics},
        )

    def end(self) -> None:
        """See `Cell`: the instruction is taken back; where that fails, the policy's process is ended."""
        if not self._instruction:
            return
        try:
            view = self._host.supervisor.view("inference")
            if view.phase != "running" or view.report is None:
                return
            if view.report.instruction not in (self._instruction, "") and self._report_of_this(view) is not None:
                return  # somebody else's by now
            if self._set(view, "", _END_S):
                raise StateError("The backend does not take its instruction back.")
        except RoboNeuronError as error:
            log.error("The policy is stopped, because it could not be told to end: %s", error)
            with suppress(StateError):
                self._host.loop.stop("inference")
        finally:
            self._instruction = ""

    def evidence(self) -> tuple[Picture, ...]:
        """See `Cell`."""
        frames = [frame for camera in self._cameras if (frame := self._frame(camera)) is not None]
        return tuple(_jpeg(frame) for frame in frames)

    def _set(self, view: ModuleView, text: str, timeout_s: float) -> str:
        """Tell the backend an instruction; returns why it was refused."""
        assert view.choice is not None
        assert view.process is not None
        parameters = self._host.supervisor.parameters(f"/{view.choice.settings.status_name}", view.process)
        return parameters.set({INSTRUCTION_PARAMETER: text}, timeout_s) or ""

    def _report_of_this(self, view: ModuleView) -> Report | None:
        """The newest report, once it is of the instruction that was given last."""
        report = view.report
        return report if report is not None and report.instruction_count > self._count else None

    def _done(self) -> bool | None:
        report = self._report_of_this(self._host.supervisor.view("inference"))
        if not self._instruction or report is None or report.actions_for_instruction == 0:
            return None
        said = next((report.metrics[name] for name in _DONE if name in report.metrics), "")
        try:
            return float(said) >= 0.5 if said else None
        except ValueError:
            return None

    def _check_not_latched(self) -> None:
        if self._host.loop.emergency_stop.is_latched():
            raise RefusedError(
                "The emergency stop is latched: nothing would move.",
                hint="A person releases it: see reset_emergency_stop.",
            )

    def _frames(self) -> dict[str, Frame]:
        roles = self._host.loop.camera_roles()
        found = {roles.get(camera, camera): self._frame(camera) for camera in self._cameras}
        return {role: frame for role, frame in found.items() if frame is not None}

    def _image_topic(self, camera: str) -> str:
        return f"/{self._host.config.namespace}/camera/{camera}/image"

    def _frame(self, camera: str) -> Frame | None:
        return self._inputs.frame(self._image_topic(camera), camera, self._profile)


def _jpeg(frame: Frame) -> Picture:
    from PIL import Image as Pillow  # heavy

    buffer = io.BytesIO()
    Pillow.fromarray(frame.image).save(buffer, "JPEG", quality=_QUALITY)
    return Picture(data=buffer.getvalue(), mime_type="image/jpeg")

"""The control module with its real controller and limits on a test clock, and an arm that follows
exactly and is checked by `MotionJudge`.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from motion_judge import MotionJudge
from std_msgs.msg import Float64MultiArray

from roboneuron.config import ModuleSettings, parse_config
from roboneuron.contract import JointCommand, JointSample
from roboneuron.errors import RefusedError
from roboneuron.gate.motion import DriverLimiter
from roboneuron.modules.arm_paths import ArmPaths
from roboneuron.modules.command_guard import joint_rules
from roboneuron.modules.control.module import ControlModule
from roboneuron.modules.status import StatusWriter
from roboneuron.modules.step_filters import StepFilter
from roboneuron.ros.messages import to_joint_state
from roboneuron.tools.arm.limit_reports import LimitReports


class Clock:
    """Replaces the module `time` in control."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def time_ns(self) -> int:
        return 1_700_000_000_000_000_000 + round(self.now_s * 1e9)


class _Publisher:
    def __init__(self) -> None:
        self.messages: list[Any] = []

    def publish(self, message: Any) -> None:
        self.messages.append(message)


class _Host:
    """The part of the node that control uses, without a ROS process."""

    def __init__(self, settings: ModuleSettings, clock: Clock) -> None:
        self.settings, self._clock = settings, clock
        self.status = StatusWriter(settings.status_name)
        self.filters: list[StepFilter] = []
        self.resources = ExitStack()
        self.stopped, self.needs_start = False, ""
        self.publishers: dict[str, _Publisher] = {}
        self.subscribed: dict[str, Callable[..., None]] = {}
        self.repeated: list[Callable[[], None]] = []

    def now_ns(self) -> int:
        return self._clock.time_ns()

    def is_server_silent(self) -> bool:
        return False

    def advertise(self, message_type: type, topic: str) -> _Publisher:
        return self.publishers.setdefault(topic, _Publisher())

    def subscribe(self, message_type: type, topic: str, callback: Callable[..., None]) -> None:
        self.subscribed[topic] = callback

    def repeat(self, period_s: float, callback: Callable[[], None]) -> None:
        self.repeated.append(callback)

    def add_parameter(self, *_: Any) -> Callable[[], None]:
        return lambda: None


class ControlLoop:
    """An active control and its arm.

    Attributes:
        control: the module.
        holds: number of holds sent.
        commands: number of other commands sent.
        changed: what the robot module's limits would do to them: they pass every one as it is.
    """

    def __init__(self, config: str, judge: MotionJudge, state: Path, clock: Clock) -> None:
        self.clock, self.judge = clock, judge
        settings = ModuleSettings(
            kind="control",
            node_name="control",
            config=parse_config(config),
            state_directory=str(state),
        )
        self.host = _Host(settings, clock)
        self.control = ControlModule(self.host)  # type: ignore[arg-type]
        self.control.filters.add(LimitReports(self.control))
        self.holds = self.commands = 0
        self.changed: list[str] = []
        self._driver_limits = DriverLimiter(
            self.control.profile, joint_rules(self.host.settings.config.limits)
        )
        limits, profile = settings.config.limits, self.control.profile
        self._paths = ArmPaths(
            settings.config, lambda: self.control.registry, lambda: limits
        ).driver_paths(settings.config.robot.name, profile)
        self._command_hold = self.control._command_hold
        self.control._command_hold = self._note_hold  # type: ignore[method-assign]
        self._is_hold = False
        self.control.activate()
        self.measure()

    def _note_hold(self, joints: JointSample) -> None:
        self._is_hold = True
        self._command_hold(joints)

    def joints(self) -> JointSample:
        """The current measurement."""
        facts, finger = self.judge.facts, self.judge.finger()
        return JointSample(
            names=(*facts.joints, facts.finger[0]),
            position=np.append(self.judge.place(self.clock.now_s), finger),
            stamp_ns=self.clock.time_ns(),
        )

    def measure(self) -> None:
        """Deliver a joint state."""
        self.host.subscribed["joint_states"](to_joint_state(self.joints()))

    def go(self, seconds: float) -> None:
        """Advance time, with the watchdog's checks and measurements of the arm."""
        self.clock.now_s += seconds
        self.measure()
        self.host.repeated[0]()
        self._follow()

    def receive(self, message: Float64MultiArray, age_s: float = 0.0) -> None:
        """Deliver an action sent `age_s` ago."""
        sent_ns = self.clock.time_ns() - round(age_s * 1e9)
        self.host.subscribed["action"](message, {"source_timestamp": sent_ns})
        self._follow()

    def _follow(self) -> None:
        sent = self.host.publishers["joint_trajectory"].messages
        now_s = self.clock.now_s
        for message in sent:
            (point,) = message.points
            lasts_s = point.time_from_start.sec + point.time_from_start.nanosec / 1e9
            names, position = tuple(message.joint_names), np.array(point.positions)
            self._send(JointCommand(names=names, position=position, duration_s=lasts_s), now_s)
            if self._is_hold:
                self.holds += 1
                self.judge.hold(names, position, now_s)
            else:
                self.commands += 1
                self.judge.command(names, position, lasts_s, now_s)
        self._is_hold = False
        sent.clear()

    def _send(self, command: JointCommand, now_s: float) -> None:
        """Pass a command as the robot module does."""
        joints = self.joints()
        self._driver_limits.measure(joints)
        self._paths.measure(joints, now_s)
        try:
            (admitted,) = self._driver_limits.admit([command], now_s)
            (admitted,), too_fast = self._paths.limit([admitted])
            self.changed += [too_fast] * bool(too_fast)
            passed = self._driver_limits.limit(admitted, now_s)
        except RefusedError as error:
            self.changed.append(error.message)
            return
        self.changed += [passed.reason] * bool(passed.acted)
        self._driver_limits.note_sent(passed.command, now_s)

    def acted(self) -> set[str]:
        """Names of the limits that have acted: scaled, held or refused."""
        message = self.host.status.to_message()
        values = {pair.key for pair in message.values}
        return {key.removeprefix("limited.") for key in values if key.startswith("limited.")} | {
            word.removeprefix("limit_") for word in self.drops() if word.startswith("limit_")
        }

    def drops(self) -> dict[str, int]:
        """Number of dropped messages, by reason."""
        return dict(self.host.status.dropped)

    def close(self) -> None:
        self.host.resources.close()

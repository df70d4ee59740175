"""Robot module: executes joint commands within the joints' limits with a driver, publishes measured
states, and holds when commands cease.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from roboneuron.config import LimitsConfig
from roboneuron.contract import JointCommand, LookaheadDriver, RobotDriver, RobotState
from roboneuron.errors import NotReadyError, RefusedError
from roboneuron.gate.motion import check_tighter
from roboneuron.modules.command_guard import CommandGuard
from roboneuron.modules.last_command import LastCommand
from roboneuron.modules.module_host import LimitedModule, ModuleHost
from roboneuron.modules.plugin import build, load_profile
from roboneuron.modules.settings import FAULT_DETAIL, HOLDING_NOTE, NEEDS_NEW_START
from roboneuron.modules.worker import LIMIT_S, Worker
from roboneuron.planning import find_robot
from roboneuron.ros.host import NodeTopics
from roboneuron.ros.messages import to_joint_state
from roboneuron.ros.topics import JOINT_COMMAND, JOINT_STATES, JOINT_TRAJECTORY

_DETAIL_PERIOD_S = 0.1
"""Period of the robot's facts in the status, much lower than the rate of states (up to 1000 Hz)."""
_IDLE_S = 0.05
"""Longest wait for a command; bounds the error of `command_timeout_s`."""
_LOADING_S, _CHECK_S = 60.0, 5.0
"""Longest time for the first step of the path check, which loads libraries and meshes, and for the
way to one point.
"""
_MOST_BEHIND_S = 0.05
"""States that are later than this are skipped, so that no burst of outdated states is published."""


class RobotModule(LimitedModule):
    """Three threads beside the executor: one publishes measured states, one plays trajectories
    point by point, one checks long paths before they are played.

    The executor handles commands and stops. It replaces the plan under the condition `_arrived`.
    The playing thread takes one point after the other from it, and sends outside the lock, so that
    a blocking driver never delays a stop.

    A command that cannot be meant is refused when it comes, and leaves the one before it in force.
    Each point is limited when it is sent, from where the arm then is.

    Attributes:
        driver: the open driver of the robot.
        profile: the robot's profile.
        on_sent: called with each command as sent by the driver, on the playing thread.
        on_state: called ten times a second with the state that the driver has read, on the
            publishing thread; with None when it cannot be read.
    """

    def __init__(self, node: ModuleHost) -> None:
        """Connect to the robot or start the simulation; the robot holds its posture.

        Raises:
            ConfigurationError: the robot has no such driver.
            RoboNeuronError: the driver cannot connect.
        """
        super().__init__(node)
        self._active = False
        self._has_fault = False
        self._next_state_s = 0.0
        self._detail_s = 0.0
        # rest of the newest trajectory, and the time of its next point [monotonic s]
        self._pending: list[JointCommand] = []
        self._due_s = 0.0
        # newest command whose path is being checked, and its topic
        self._unchecked: tuple[list[JointCommand], str] | None = None
        # guards these three
        self._arrived = threading.Condition()
        self.on_sent: list[Callable[[JointCommand], None]] = []
        self.on_state: list[Callable[[RobotState | None], None]] = []
        section = self.config.robot
        _, spec = find_robot(self.registry, section.name, section.driver)
        self.profile = load_profile(self.registry, section)
        self._last = LastCommand(self.profile.kinds, section.command_timeout_s)
        self._topics = NodeTopics(node, accepts=lambda: self._active and not self.why_stopped())
        node.resources.callback(self._topics.close)
        self.driver = cast(
            "RobotDriver",
            build(spec, self.config.options(section.name), self.profile, self._topics),
        )
        self._guard = CommandGuard(node, self.profile, self.driver, self.limits_at_start)
        self.offer_limits()
        node.resources.callback(self.driver.close)
        self.driver.open()
        self._states = node.advertise(JointState, JOINT_STATES)
        node.subscribe(JointTrajectory, JOINT_TRAJECTORY, self._on_command)
        node.subscribe(JointState, JOINT_COMMAND, self._on_command)
        self._reader = Worker("robot-state", self._publish_state, self.status)
        self._player = Worker("robot-command", self._play, self.status)
        self._checker = Worker("robot-path", self._check_long, self.status, limit_s=_LOADING_S)
        node.resources.callback(self._reader.stop)
        node.resources.callback(self._checker.stop)
        node.resources.callback(self._player.stop)
        self.status.set_value("driver", spec.name)

    def activate(self) -> None:
        """Publish states and accept commands."""
        self.status.set_waiting("the first joint state from the driver")
        self._next_state_s = time.monotonic()
        self._active = True
        self._reader.start()
        self._player.start()
        self._checker.start()

    def deactivate(self) -> None:
        """Hold, then stop publishing.

        Raises:
            NotReadyError: the driver hangs in a call.
        """
        self._active = False
        self._drop_plan()
        self._checker.stop()
        # first: a command that is being sent now must not come after the hold
        player_ended = self._player.stop()
        self._hold()
        if not (self._reader.stop() and player_ended):
            raise NotReadyError("The driver hangs; the robot's own safety functions must hold it.")

    def stop(self, code: str) -> None:
        """Drop pending commands, and brake unless the robot has stopped by itself; see
        `Module.stop`. Commands are refused until motion is requested again.
        """
        # in this order, because a pending command would follow the hold
        self._drop_plan()
        self._guard.revoke_claim()
        if code != NEEDS_NEW_START:
            self.status.set(note=f"{HOLDING_NOTE}{self.node.needs_start}")
            self._hold()

    def use_limits(self, limits: LimitsConfig) -> None:
        """See `LimitedModule.use_limits`."""
        self.check_limits(limits)
        self._guard.use(limits)

    def check_limits(self, limits: LimitsConfig) -> None:
        """See `LimitedModule.check_limits`."""
        check_tighter(limits, self.config.limits)

    def _hold(self) -> None:
        """Make the driver brake; the next command starts from where the arm then is."""
        self._guard.limits.note_hold()
        self.driver.hold()

    def _drop_plan(self) -> None:
        with self._arrived:
            # a new list: the playing thread sees by its identity that its plan was replaced
            self._pending, self._unchecked = [], None
            self._arrived.notify_all()

    def _on_command(self, message: JointTrajectory | JointState, info: dict[str, Any]) -> None:
        if not self._active:
            return
        if reason := self.why_stopped():
            self.status.drop(reason)
            return
        # by `source_timestamp`, the time of sending [ns]
        commands = self._guard.admit(message, int(info["source_timestamp"]))
        if not commands:
            return
        topic = JOINT_COMMAND if isinstance(message, JointState) else JOINT_TRAJECTORY
        if not self._guard.is_short(commands):
            with self._arrived:
                self._unchecked = commands, topic
                self._arrived.notify_all()
        elif limited := self._guard.limit_path(commands, topic):
            with self._arrived:
                self._accept(limited)

    def _accept(self, commands: list[JointCommand]) -> None:
        """Replace the plan; called under `_arrived`."""
        self._unchecked = None
        self._pending, self._due_s = commands, time.monotonic()
        self._arrived.notify_all()

    def _check_long(self, stop: threading.Event) -> None:
        """Check the path of a command that takes longer than the executor may be kept from a stop;
        a newer command that is accepted, or a stop, replaces it.

        The first step loads what the check needs: a start need not wait for that.
        """
        if self._guard.is_loading:
            self._guard.load_paths(self.registry)
            self._checker.limit_s = _CHECK_S
        with self._arrived:
            self._arrived.wait_for(
                lambda: self._unchecked is not None or stop.is_set(), timeout=_IDLE_S
            )
            asked = self._unchecked
        if asked is None or stop.is_set():
            return
        commands, topic = asked

        def is_current() -> bool:
            self._checker.progress()
            return self._unchecked is asked

        limited = self._guard.limit_path(commands, topic, is_current)
        with self._arrived:
            if self._unchecked is not asked:
                return
            self._unchecked = None
            if limited and not self.why_stopped():
                self._accept(limited)

    def _play(self, stop: threading.Event) -> None:
        """Send the next pending command; a newer trajectory replaces the rest of the older one.

        A point is taken under the lock, sent without it, and its time awaited under it again.
        Changes in between are detected afterwards: a stop by `why_stopped`, another trajectory by
        the identity of its list.
        """
        with self._arrived:
            if not self._arrived.wait_for(
                lambda: bool(self._pending) or stop.is_set(), timeout=_IDLE_S
            ):
                self._hold_when_silent()
                return
            if stop.is_set():
                return
            plan = self._pending
            command = plan.pop(0)
            planned = tuple(plan)
            began_s = time.monotonic()
            is_late = began_s - self._due_s > self.config.robot.command_timeout_s
            # A command that is played late starts from the measured posture; with its own timing
            # the arm would have to catch up, but not where its time waits for commands.
            if not getattr(self.driver, "waits_for_commands", False):
                command = replace(
                    command, duration_s=command.duration_s + max(0.0, began_s - self._due_s)
                )
            # this process was frozen, or the driver did not return: the rest of the plan is
            # outdated
            if is_late:
                self._pending = []
        if is_late:
            self.status.drop("stale_command")
            self._hold()
            return
        # from here on the command returned by the driver counts: it may have shortened it
        sent = self._execute(command, planned)
        if sent is None:
            # without this point, the next ones would be sent too early, on a way nobody has checked
            plan.clear()
            if planned:
                self._hold()
            return
        if self.why_stopped():  # since it was taken: the hold of that stop came before the command
            self._drop_plan()
            self._hold()
            return
        for note in self.on_sent:
            note(sent)
        self._last.note_sent(sent, time.monotonic())
        self.status.clear_error()
        self.status.set(note="moving")
        # a slow motion is not a hang
        self._player.limit_s = sent.duration_s + LIMIT_S
        self._player.progress()
        with self._arrived:
            # the next point is due when this one was to be reached, whatever time sending it took
            if plan and self._pending is plan:
                self._due_s = began_s + sent.duration_s
                self._arrived.wait_for(
                    lambda: self._pending is not plan or stop.is_set(), timeout=sent.duration_s
                )

    def _execute(
        self, command: JointCommand, planned: tuple[JointCommand, ...]
    ) -> JointCommand | None:
        """Limit a point and send it; return it as sent, or None if limits or driver refuse it."""
        try:
            command, now_s = self._guard.limit(command)
        except RefusedError as error:
            self._guard.refuse(error.rule, error.message)
            return None
        except Exception as error:  # a driver may raise anything when it is read
            self._guard.refuse("not_measured", f"The joints cannot be read: {error}")
            return None
        try:
            sent = self._send(command, planned)
        except Exception as error:  # likewise
            self.status.drop("refused_command")
            self.status.set_error(error)
            return None
        # not as sent: a driver may report the time that it would need from rest
        self._guard.limits.note_sent(command, now_s)
        return sent

    def _send(self, command: JointCommand, planned: tuple[JointCommand, ...]) -> JointCommand:
        """Give the driver a point and, if it accepts a look-ahead, the points after it.

        They are given again when they are due, so that this module does not depend on the driver's
        use of the look-ahead.
        """
        if planned and isinstance(self.driver, LookaheadDriver):
            return self.driver.send_ahead(command, planned)
        return self.driver.send(command)

    def _hold_when_silent(self) -> None:
        """Hold once when commands have ceased."""
        if self._last.has_ceased(time.monotonic()):
            self._hold()
            self.status.set(note=f"{HOLDING_NOTE}no command")

    def _publish_state(self, stop: threading.Event) -> None:
        """Publish one state when it is due, on a fixed time grid, so that the mean rate is
        right.
        """
        stop.wait(max(0.0, self._next_state_s - time.monotonic()))
        self._next_state_s = max(
            self._next_state_s + 1.0 / self.config.robot.state_rate_hz,
            time.monotonic() - _MOST_BEHIND_S,
        )
        if stop.is_set():
            return
        try:
            state = self.driver.read()
        except Exception:
            self._last.measure(None)
            self._guard.measure(None)
            # the state at the last publication may be outdated
            self.status.forget_details()
            for tell in self.on_state:
                tell(None)
            self._detail_s = 0.0
            raise
        # first of all: control waits for it
        self._states.publish(to_joint_state(state.joints))
        self._last.measure(state.joints)
        self._guard.measure(state.joints)
        self.status.output.tick()
        self.status.set_ready()
        self._check_fault(state.detail.get(FAULT_DETAIL, ""))
        now_s = time.monotonic()
        if now_s - self._detail_s > _DETAIL_PERIOD_S:
            self._detail_s = now_s
            self.status.set_details(state.detail)
            for tell in self.on_state:
                tell(state)

    def _check_fault(self, fault: str) -> None:
        """Count a fault that has stopped the robot, and require a new start: clearing it, also on
        the robot itself, sets nothing in motion.

        Args:
            fault: text from the driver; empty for none. Counted once, when it appears.
        """
        if fault and not self._has_fault:
            self.node.require_start(f"a fault of the robot: {fault}")
        self._has_fault = bool(fault)

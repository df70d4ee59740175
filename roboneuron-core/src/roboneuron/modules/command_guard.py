"""Joint commands on their way to the driver: refused when they come, limited when they are sent."""

from __future__ import annotations

import logging
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence

from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from roboneuron.config import LimitsConfig
from roboneuron.contract import JointCommand, JointSample, RobotDriver, RobotProfile, to_ns
from roboneuron.errors import InvalidInputError, RefusedError, RoboNeuronError
from roboneuron.gate.motion import (
    MOST_POINTS,
    DriverLimiter,
    DriverPaths,
    MotionRules,
    motion_rules,
)
from roboneuron.modules.arm_paths import ArmPaths
from roboneuron.modules.module_host import ModuleHost
from roboneuron.modules.settings import (
    FUTURE_S,
    PLACES_CHECKED,
    PLACES_UNCHECKED,
    REFUSED_COMMAND,
)
from roboneuron.plugins.registry import Registry
from roboneuron.ros.graph import server_node
from roboneuron.ros.messages import commands_from_message
from roboneuron.ros.topics import JOINT_COMMAND, JOINT_TRAJECTORY

_REPORT_PERIOD_S = 1.0
"""Rate limit of the log and of the search for senders, for a node that keeps sending commands."""
log = logging.getLogger(__name__)


class CommandGuard:
    """Applies age limits and the joints' limits to commands, whoever sends them, and keeps others
    from an arm that the server or its control moves.

    Its server and control sign their commands. Each claims the arm for its duration and
    `command_timeout_s`; until then commands of others are refused. A stop ends the claim.

    A refused command is counted in `dropped` and described in the status, but is no failure of the
    module: any node may send it.

    `admit` is called on the executor's thread, `limit` on the playing thread, `measure` on the
    publishing one; `limit_path` on any.

    Attributes:
        limits: of the robot's joints.
        is_loading: `load_paths` has to be called before any command may pass.
    """

    def __init__(
        self,
        node: ModuleHost,
        profile: RobotProfile,
        driver: RobotDriver,
        limits: LimitsConfig,
    ) -> None:
        """Args:
        node: of the robot module.
        profile: profile of the robot.
        driver: read when a command comes before the first state.
        limits: in force at the start.

        Raises:
            ConfigurationError: the limits do not fit the robot.
        """
        self._node, self._driver, self._status = node, driver, node.status
        self._profile, self._config = profile, node.settings.config
        self._timeout_s = self._config.robot.command_timeout_s
        self.limits = DriverLimiter(profile, joint_rules(limits))
        self._limits = limits
        self._joints: JointSample | None = None
        motion_rules(limits, profile)
        self._paths: DriverPaths | None = None
        self.is_loading = bool(profile.tcp_link)
        self._server = server_node(os.getppid())
        # until when only the server and its control may command the arm [monotonic s]
        self._claimed_s = 0.0
        self._limited: Counter[str] = Counter()
        self._reported_s = 0.0

    def admit(self, message: JointTrajectory | JointState, sent_ns: int) -> list[JointCommand]:
        """Return the points of a command that comes now; empty if it is refused.

        Args:
            message: as received.
            sent_ns: time of sending [ns].
        """
        topic = JOINT_COMMAND if isinstance(message, JointState) else JOINT_TRAJECTORY
        try:
            is_ours = message.header.frame_id == self._server
            if not is_ours and time.monotonic() < self._claimed_s:
                raise RefusedError("The server or its control moves the arm.", rule="claimed")
            self._check_age(sent_ns, to_ns(message.header.stamp))
            if (count := len(getattr(message, "points", ()))) > MOST_POINTS:
                raise RefusedError(
                    f"A trajectory has {count} points, at most {MOST_POINTS} are allowed.",
                    rule="too_many_points",
                )
            commands = commands_from_message(message)
            self._measure()
            admitted = self.limits.admit(commands, self._now_s())
            if is_ours:
                lasts_s = sum(command.duration_s for command in admitted)
                self._claimed_s = time.monotonic() + lasts_s + self._timeout_s
            return admitted
        except InvalidInputError as error:
            reason = "malformed_command" if _is_finite(message) else "not_finite"
            self.refuse(reason, error.message, topic)
        except RefusedError as error:
            self.refuse(error.rule, error.message, topic)
        except Exception as error:  # the driver may raise anything when it is read
            self.refuse("not_measured", f"The joints cannot be read: {error}", topic)
        return []

    def load_paths(self, registry: Registry) -> None:
        """Load what checks places and distances, by the controller of [control]; without one for
        this robot they are not checked, which the status says.
        """
        paths = ArmPaths(self._config, lambda: registry, lambda: self._limits)
        try:
            made = paths.driver_paths(self._config.robot.name, self._profile)
        except RoboNeuronError as error:
            log.warning("Places and collisions are not checked before the driver: %s", error)
            self._status.set_value(PLACES_UNCHECKED, str(error))
        else:
            made.measure(self._joints, time.monotonic())
            self._paths = made
            # last: the limits may have changed meanwhile
            made.use(motion_rules(self._limits, self._profile))
        self._status.set_value(PLACES_CHECKED, self._paths is not None)
        self.is_loading = False

    def is_short(self, commands: Sequence[JointCommand]) -> bool:
        """Whether `limit_path` takes about a millisecond at most."""
        if self._paths is None:
            return not self.is_loading
        return self._paths.is_short(commands)

    def limit_path(
        self,
        commands: list[JointCommand],
        topic: str = JOINT_TRAJECTORY,
        is_current: Callable[[], bool] = lambda: True,
    ) -> list[JointCommand]:
        """Return the points of an admitted command with the time that the TCP needs on their way;
        empty if that leads where the arm may not be, which refuses the command.

        Args:
            commands: as `admit` returned them.
            topic: on which the command came.
            is_current: see `DriverPaths.limit`.
        """
        if self._paths is None:
            return commands
        try:
            commands, too_fast = self._paths.limit(commands, is_current)
        except RefusedError as error:
            self.refuse(error.rule, error.message, topic)
            return []
        except Exception as error:  # the controller is a plugin, which may raise anything
            self.refuse("limit_kinematics", f"The path cannot be checked: {error}", topic)
            return []
        if too_fast:
            self._note_limited(("speed",), too_fast)
        return commands

    def revoke_claim(self) -> None:
        """Let anybody command the arm again, because it was stopped."""
        self._claimed_s = 0.0

    def use(self, limits: LimitsConfig) -> None:
        """Apply other limits from the next command on."""
        self._limits = limits
        self.limits.use(joint_rules(limits))
        if self._paths is not None:
            self._paths.use(motion_rules(limits, self._profile))

    def measure(self, joints: JointSample | None) -> None:
        """Record the newest measured joints; None if they are unknown."""
        self._joints = joints
        self.limits.measure(joints)
        if self._paths is not None:
            self._paths.measure(joints, time.monotonic())

    def limit(self, command: JointCommand) -> tuple[JointCommand, float]:
        """Return the command to give to the driver now, and the arm's time [s].

        Raises:
            RefusedError: the limits refuse it.
            Exception: whatever the driver raises when it is read.
        """
        self._measure()
        now_s = self._now_s()
        passed = self.limits.limit(command, now_s)
        if passed.acted:
            self._note_limited(passed.acted, passed.reason)
        return passed.command, now_s

    def _note_limited(self, names: Sequence[str], reason: str) -> None:
        self._limited.update(names)
        for name in names:
            self._status.set_value(f"limited.{name}", self._limited[name])
        self._status.set_value("limit", reason)

    def refuse(self, reason: str, what: str, topic: str = JOINT_TRAJECTORY) -> None:
        """Count a command that is not executed; the one before it goes on.

        Args:
            reason: counted in `dropped`.
            what: one sentence with the numbers.
            topic: on which it came.
        """
        self._status.drop(reason)
        now_s = time.monotonic()
        if now_s - self._reported_s < _REPORT_PERIOD_S:
            return
        self._reported_s = now_s
        senders = self._node.senders(topic)
        text = f"{reason}: {what[:300]}" + (f" It may come from {senders}." if senders else "")
        log.warning("A command was refused: %s", text)
        self._status.set_value(REFUSED_COMMAND, text)
        self._status.changed.set()

    def _check_age(self, sent_ns: int, stamp_ns: int) -> None:
        """Check when a command was sent, and when it begins by its header (0 for at once)."""
        now_ns = time.time_ns()
        for name, at_ns in (("sent", sent_ns), ("stamped", stamp_ns or sent_ns)):
            age_s = (now_ns - at_ns) / 1e9
            if age_s > self._timeout_s:
                raise RefusedError(f"It was {name} {age_s:.3g} s ago.", rule="stale_command")
            if age_s < -FUTURE_S:
                raise RefusedError(f"It was {name} {-age_s:.3g} s ahead.", rule="future_command")
        self._status.latency.append((now_ns - sent_ns) / 1e6)

    def _measure(self) -> None:
        """Read the driver if the joints are not known yet, or no longer as by the last state."""
        if self._waits or not self.limits.is_measured:
            self.measure(self._driver.read().joints)

    @property
    def _waits(self) -> bool:
        return bool(getattr(self._driver, "waits_for_commands", False))

    def _now_s(self) -> float:
        """The arm's time: where its time waits for commands, each of them has been executed."""
        return self.limits.ends_s if self._waits else time.monotonic()


def _is_finite(message: JointTrajectory | JointState) -> bool:
    if isinstance(message, JointState):
        return all(map(math.isfinite, message.position))
    return all(math.isfinite(value) for point in message.points for value in point.positions)


def joint_rules(limits: LimitsConfig) -> MotionRules:
    """The rules of limits for joints; those for the TCP need a controller."""
    return MotionRules(
        reactions={},
        velocity_fraction=limits.velocity_fraction,
        acceleration_fraction=limits.acceleration_fraction,
    )

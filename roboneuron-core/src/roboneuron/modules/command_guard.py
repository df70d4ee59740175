"""Joint commands on their way to the driver: refused when they come, limited when they are sent."""

from __future__ import annotations

import logging
import math
import time
from collections import Counter

from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from roboneuron.config import LimitsConfig
from roboneuron.contract import JointCommand, RobotDriver, RobotProfile
from roboneuron.errors import InvalidInputError, RefusedError
from roboneuron.gate.motion import MOST_POINTS, DriverLimiter, MotionRules
from roboneuron.modules.module_host import ModuleHost
from roboneuron.modules.settings import FUTURE_S, REFUSED_COMMAND
from roboneuron.ros.messages import commands_from_message, to_ns
from roboneuron.ros.topics import JOINT_COMMAND, JOINT_TRAJECTORY

_REPORT_PERIOD_S = 1.0
"""Rate limit of the log and of the search for senders, for a node that keeps sending commands."""
log = logging.getLogger(__name__)


class CommandGuard:
    """Applies age limits and the joints' limits to commands, whoever sends them.

    A refused command is counted in `dropped` and described in the status, but is no failure of the
    module: any node may send it.

    `admit` is called on the executor's thread, `limit` on the playing thread, `limits.measure` on
    the publishing one.

    Attributes:
        limits: of the robot's joints.
    """

    def __init__(
        self, node: ModuleHost, profile: RobotProfile, driver: RobotDriver, limits: LimitsConfig
    ) -> None:
        """Args:
        node: of the robot module.
        profile: profile of the robot.
        driver: read when a command comes before the first state.
        limits: in force at the start.
        """
        self._node, self._driver, self._status = node, driver, node.status
        self._timeout_s = node.settings.config.robot.command_timeout_s
        self.limits = DriverLimiter(profile, joint_rules(limits))
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
            self._check_age(sent_ns, to_ns(message.header.stamp))
            if (count := len(getattr(message, "points", ()))) > MOST_POINTS:
                raise RefusedError(
                    f"A trajectory has {count} points, at most {MOST_POINTS} are allowed.",
                    rule="too_many_points",
                )
            commands = commands_from_message(message)
            self._measure()
            return self.limits.admit(commands, self._now_s())
        except InvalidInputError as error:
            reason = "malformed_command" if _is_finite(message) else "not_finite"
            self.refuse(reason, error.message, topic)
        except RefusedError as error:
            self.refuse(error.rule, error.message, topic)
        except Exception as error:  # the driver may raise anything when it is read
            self.refuse("not_measured", f"The joints cannot be read: {error}", topic)
        return []

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
            self._limited.update(passed.acted)
            for name in passed.acted:
                self._status.set_value(f"limited.{name}", self._limited[name])
            self._status.set_value("limit", passed.reason)
        return passed.command, now_s

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
            self.limits.measure(self._driver.read().joints)

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

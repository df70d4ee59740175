"""Stepped time: a simulation that goes on only while commands are carried out. Pure arithmetic on
given times.
"""

from __future__ import annotations

from enum import IntEnum

from std_msgs.msg import Float64MultiArray

CLOCK_TOPIC = "sim/clock"
"""std_msgs/Float64MultiArray: phase, count, since (seconds, nanoseconds; ROS time) and simulated
time [s] of a stepped simulation.
"""
TURN_TOPIC = "sim/turn"
"""std_msgs/Float64MultiArray: a `TurnWord`, and the count of commands that it is about; told by
control.
"""
SETTLE_S = 1.5
"""Simulated time that passes after the last command, in which arm and objects come to rest."""
ALONE_S = 0.45
"""A command that lasts this long is no part of a sequence: it settles at its end."""
PATIENCE_S = 30.0
"""Wall time without a command after which a sequence counts as ended, if nobody has said so."""


class WorldPhase(IntEnum):
    """What a stepped simulation does."""

    MOVING = 0
    """It carries out a command."""
    WAITING = 1
    """It stands, perhaps in the middle of a motion, until the next command or `PATIENCE_S`."""
    SETTLING = 2
    """Nothing was commanded any more: arm and objects come to rest."""
    RESTING = 3
    """It stands until the next command."""


class TurnWord(IntEnum):
    """What control tells a stepped simulation."""

    SKIPPED = 0
    """An action moves nothing, and counts as carried out."""
    ENDED = 1
    """No command follows the one with this count."""


class SteppedTime:
    """How many steps a simulation may make: as many as its commands last, whatever wall time they
    take to come. Not thread-safe.

    Attributes:
        phase: what it does now.
        count: commands carried out to their end.
        since_ns: ROS time at which the present phase has begun [ns].
    """

    def __init__(self, step_s: float) -> None:
        """`step_s` is simulated time per step [s]. It begins by settling."""
        self._step_s = step_s
        self.phase, self.count, self.since_ns = WorldPhase.SETTLING, 0, 0
        self._left = self._settling = round(SETTLE_S / step_s)
        self._since_s = 0.0
        self._is_alone = False

    @property
    def stands(self) -> bool:
        """Whether no step is made before the next command or the end of the patience."""
        return self.phase in (WorldPhase.WAITING, WorldPhase.RESTING)

    def command(self, duration_s: float, now_ns: int) -> None:
        """Make the steps of a command; it replaces the rest of the one before."""
        self._left = max(1, round(duration_s / self._step_s))
        self._is_alone = duration_s >= ALONE_S
        self._enter(WorldPhase.MOVING, now_ns)

    def take_turn(self, word: TurnWord, count: int, now_ns: int) -> None:
        """Take what control tells; one about an earlier command is ignored."""
        if word is TurnWord.SKIPPED:
            self.count += 1
            if self.stands:
                self.since_ns = now_ns  # whoever acts next looks anew
        elif self.phase is WorldPhase.WAITING and count == self.count:
            self.settle(now_ns)

    def settle(self, now_ns: int) -> None:
        """Make steps until all rests, without waiting for another command."""
        if self.phase is not WorldPhase.RESTING:
            self._left = self._settling
            self._enter(WorldPhase.SETTLING, now_ns)

    def grant(self, due: int, now_s: float, now_ns: int) -> int:
        """How many of `due` steps may be made.

        Args:
            due: by the wall clock.
            now_s: monotonic time.
            now_ns: ROS time.
        """
        if self.phase is WorldPhase.WAITING and now_s - self._since_s > PATIENCE_S:
            self.settle(now_ns)
        if self.stands:
            return 0
        steps = min(due, self._left)
        self._left -= steps
        return steps

    def note_made(self, now_s: float, now_ns: int) -> bool:
        """Note that the granted steps were made; returns True if it stands since then."""
        if self.stands or self._left:
            return False
        is_command = self.phase is WorldPhase.MOVING
        self.count += is_command
        self._since_s = now_s
        self._enter(WorldPhase.WAITING if is_command else WorldPhase.RESTING, now_ns)
        if is_command and self._is_alone:
            self.settle(now_ns)
            return False
        return True

    def _enter(self, phase: WorldPhase, now_ns: int) -> None:
        self.phase, self.since_ns = phase, now_ns


def to_clock(stepped: SteppedTime, time_s: float) -> Float64MultiArray:
    """The message on `CLOCK_TOPIC`; `time_s` is the simulated time [s]."""
    seconds, nanoseconds = divmod(stepped.since_ns, 1_000_000_000)
    values = [stepped.phase, stepped.count, seconds, nanoseconds, time_s]
    return Float64MultiArray(data=[float(value) for value in values])

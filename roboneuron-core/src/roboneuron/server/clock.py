"""Time of a robot, as the server's tools follow it: the real one, or that of a simulation that
waits for commands.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator

from roboneuron.contract import JointSample
from roboneuron.server.motion_gate import TimedCommand

__all__ = ["MotionTiming", "RobotClock"]
"""Names that other distributions may use."""


class MotionTiming:
    """Time of one motion that is sent action by action; this base class is the real time.

    Args:
        step_s: period of the actions [s].
    """

    def __init__(self, step_s: float) -> None:
        self._step_s, self._began_s = step_s, time.monotonic()

    def elapsed_s(self) -> float:
        """Time since its beginning [s]."""
        return time.monotonic() - self._began_s

    def newer_than_ns(self) -> int:
        """Measurements from before this ROS time [ns] do not show the present."""
        return 0

    def play(self, message: object) -> Iterator[TimedCommand]:
        """Yield an action, and wait until the next one is due."""
        yield TimedCommand(message=message, due_s=time.monotonic() + self._step_s)

    def settle(self) -> None:
        """Wait until what the tool answers is measured at its end; blocks."""


class RobotClock:
    """Time of one robot; this base class is the real time. A feature may give another one, see
    `Feature.clock`. Usable from any thread.

    Attributes:
        stands: nothing changes between two motions: measurements stay true however old they are,
            and no new pictures come.
    """

    stands = False

    def motion(self, step_s: float) -> MotionTiming:
        """Begin a motion with actions of that period [s]; blocks until it may begin. Raises
        NotReadyError if it may not.
        """
        return MotionTiming(step_s)

    def await_rest(self) -> None:
        """Wait until a command may be sent; blocks. Raises NotReadyError."""

    def play_to_rest(
        self, message: object, newest: Callable[[], JointSample | None]
    ) -> Generator[TimedCommand, None, JointSample] | None:
        """Yield a command, and wait until all rests; the generator returns the joints measured
        then. None if this clock does not know when, so that the caller has to measure it.

        Args:
            message: of the command.
            newest: returns the newest joints.
        """
        return None

    def closed_at_m(self, arm: str) -> float | None:
        """Height of the TCP when that arm last closed its hand [m]; None if this clock does not
        know it, so that the caller has to measure it.
        """
        return None

"""What a simulation in stepped time tells of itself, and whether there is one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from roboneuron import InvalidInputError

if TYPE_CHECKING:
    from std_msgs.msg import Float64MultiArray

    from roboneuron.feature import Config

CLOCK_TOPIC = "sim/clock"
"""std_msgs/Float64MultiArray under the robot's namespace: phase (0 moving, 1 waiting, 2 settling, 3
resting), count of commands, since (seconds, nanoseconds; ROS time) and simulated time [s].
"""
SIMULATION_TOPIC, SKIPPED, ENDED = "sim/turn", 0, 1
"""std_msgs/Float64MultiArray under the robot's namespace, from control to the simulation: a word,
and the count of commands that it is about. `SKIPPED`: an action moves nothing, and counts as
carried out; `ENDED`: no command follows, so that arm and objects may come to rest.
"""
END_PARAMETER = "stepped_end"
"""ROS parameter of control: the count of the last command, see `ENDED`."""
TURN_PARAMETER, FREE = "stepped_turn", -1
"""ROS parameter of inference: a new positive number gives the policy a turn of one row, 0 none, and
`FREE` any.
"""
TURN_METRIC, ROWS_METRIC = "stepped_turn", "stepped_rows"
"""Values in the report of inference: number of the newest turn that is over, and rows sent since
its start.
"""
CLOSED_METRIC = "stepped_closed_at_m"
"""Value in the report of control: height of the TCP when it last closed the hand [m]; of one of
several arms as "left/stepped_closed_at_m".
"""
UNANSWERED_S = 15.0
"""Wall time after which a command that moved nothing, and of which nobody said so, counts as
refused.
"""
OPTION = "stepped"
"""Option of a simulated robot. A robot without it refuses it when it starts."""
_VALUES = 5
_WAITING, _RESTING = 1, 3


@dataclass(frozen=True, kw_only=True, slots=True)
class WorldClock:
    """A simulation in stepped time at one moment.

    Attributes:
        phase: see `CLOCK_TOPIC`.
        count: commands carried out to their end.
        since_ns: ROS time at which the phase has begun [ns]; what was measured later while it
            stands shows the same state.
        time_s: simulated time [s].
    """

    phase: int
    count: int
    since_ns: int
    time_s: float

    @property
    def stands(self) -> bool:
        """Whether no time passes until the next command, or until the wait for it has ended."""
        return self.phase in (_WAITING, _RESTING)

    @property
    def rests(self) -> bool:
        """Whether no time passes until the next command."""
        return self.phase == _RESTING


def is_stepped(config: Config) -> bool:
    """Whether the robot of a configuration is asked for stepped time."""
    return config.options(config.robot.name).get(OPTION) is True


def clock_from_message(message: Float64MultiArray) -> WorldClock:
    """Read a message on `CLOCK_TOPIC`. Raises InvalidInputError for what is none."""
    if len(message.data) != _VALUES:
        raise InvalidInputError(
            f"A message on {CLOCK_TOPIC!r} has {len(message.data)} values, expected {_VALUES}."
        )
    phase, count, seconds, nanoseconds, time_s = message.data
    return WorldClock(
        phase=int(phase),
        count=int(count),
        since_ns=int(seconds) * 1_000_000_000 + int(nanoseconds),
        time_s=float(time_s),
    )

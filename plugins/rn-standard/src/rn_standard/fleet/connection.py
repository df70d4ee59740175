"""One ROS node for all robots of a server: a node of its own for each would use up the participants
of a host.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from roboneuron.feature import Config, Connection, ModuleKind

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray

PARTICIPANTS = "ROBONEURON_PARTICIPANTS"
"""Environment variable: how many participants of this host each looks for in the range LOCALHOST.
"""
_MOST = 115
"""A domain has 250 ports, of which each participant takes two. Source: RTPS 2.2, 9.6.1.1."""
_OTHERS = 8
"""The server, and programs beside it such as `roboneuron status` or a recorder."""


def participants_of(robots: Iterable[Config]) -> int:
    """How many participants have to find each other: the modules of all robots, and a few
    others.
    """
    kinds = get_args(ModuleKind)
    modules = sum(getattr(robot, kind) is not None for robot in robots for kind in kinds)
    return min(_MOST, modules + _OTHERS)


class SharedConnection(Connection):
    """Opens the node once, and hands each robot what is reported under its namespace.

    Args:
        log_directory: for the logs of ROS itself.
    """

    def __init__(self, log_directory: Path) -> None:
        super().__init__(self._receive, log_directory)
        self._receivers: dict[str, Callable[[object], None]] = {}

    def of_robot(self, namespace: str) -> Callable[[Callable[[object], None], Path], Connection]:
        """What the supervisor of the robot with that namespace makes its connection from."""

        def connect(on_status: Callable[[object], None], log_directory: Path) -> Connection:
            self._receivers[namespace] = on_status
            return self

        return connect

    def close(self) -> None:
        """One robot has ended; the others go on with the node."""

    def end(self) -> None:
        """All robots have ended: leave the graph; idempotent."""
        super().close()

    def _receive(self, message: DiagnosticArray) -> None:
        """Take a DiagnosticArray; a module reports its own robot only, so the first entry tells
        whose it is.
        """
        for status in message.status[:1]:
            receiver = self._receivers.get(status.name.strip("/").rpartition("/")[0])
            if receiver is not None:
                receiver(message)

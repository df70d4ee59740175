"""One ROS node shared by all robots of a server: separate nodes would use up the participants of a
host.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron.feature import Config, Connection

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray

PARTICIPANTS = "ROBONEURON_PARTICIPANTS"
"""Environment variable: number of participants of this host probed in the range LOCALHOST."""
_MOST = 115
"""A domain has 250 ports, of which each participant uses two. Source: RTPS 2.2, 9.6.1.1."""
_OTHERS = 8
"""The server, and other programs such as `roboneuron status` or a recorder."""


def participants_of(robots: Iterable[Config]) -> int:
    """Number of participants that have to discover each other: the modules of all robots, and a few
    others.
    """
    modules = sum(len(robot.module_kinds) for robot in robots)
    return min(_MOST, modules + _OTHERS)


class SharedConnection(Connection):
    """Open the node once, and pass each robot the reports in its namespace.

    Args:
        log_directory: for the logs of ROS itself.
    """

    def __init__(self, log_directory: Path) -> None:
        super().__init__(self._receive, log_directory)
        self._receivers: dict[str, Callable[[object], None]] = {}

    def of_robot(self, namespace: str) -> Callable[[Callable[[object], None], Path], Connection]:
        """Return the factory of a robot's connection for its supervisor."""

        def connect(on_status: Callable[[object], None], log_directory: Path) -> Connection:
            self._receivers[namespace] = on_status
            return self

        return connect

    def close(self) -> None:
        """Keep the node open when one robot ends, because the others use it."""

    def end(self) -> None:
        """Leave the graph when all robots have ended; idempotent."""
        super().close()

    def _receive(self, message: DiagnosticArray) -> None:
        """Distribute a DiagnosticArray by its first entry's robot; a module reports its own robot
        only.
        """
        for status in message.status[:1]:
            receiver = self._receivers.get(status.name.strip("/").rpartition("/")[0])
            if receiver is not None:
                receiver(message)

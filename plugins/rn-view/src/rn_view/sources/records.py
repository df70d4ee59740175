"""Records of a robot for its operators: alarms, maintenance, past tasks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from rn_view.diagnostics.alarms import AlarmBook


class MaintenanceSwitch(Protocol):
    """Maintenance mode of a robot; implemented by
    `rn_standard.ops.maintenance.MaintenanceFeature`.
    """

    @property
    def state(self) -> object | None:
        """Who took the robot out of service and why, as text; None in service."""
        ...

    def begin(self, who: str, role: str, reason: str) -> object:
        """Take the robot out of service. Raises RoboNeuronError."""
        ...

    def end(self, who: str, role: str) -> None:
        """Put the robot back in service. Raises RoboNeuronError."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class ShownTask:
    """One past task.

    Attributes:
        number: permanent identifier: end time [s since 1970], and a count within that second.
        at_s: end time, wall clock [s].
        instruction, outcome, reason: as in the result of run_task.
        attempts, took_s: as in the result of run_task; time in seconds.
        model: what the policy was started with, as text.
        pictures: whether there is a picture of the start, and of the end.
    """

    number: str
    at_s: float
    instruction: str
    outcome: str
    reason: str
    attempts: int
    took_s: float
    model: str
    pictures: tuple[bool, bool] = (False, False)


class PastTaskList(Protocol):
    """Past tasks and their pictures."""

    def newest(self) -> Sequence[ShownTask]:
        """Newest first. Raises OSError when they cannot be read."""
        ...

    def picture(self, number: str, *, is_end: bool) -> bytes | None:
        """JPEG of the main camera at the start or end of a task; None if there is none. Blocks."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class RobotRecords:
    """Records of one robot.

    Attributes:
        alarms: its alarms.
        maintenance: None if the server has no maintenance mode.
        tasks: None if the server has no tool for tasks.
    """

    alarms: AlarmBook
    maintenance: MaintenanceSwitch | None = None
    tasks: PastTaskList | None = field(default=None)

"""What a server keeps of its robot for those who operate it: alarms, maintenance, past tasks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from rn_view.diagnostics.alarms import AlarmBook


class MaintenanceSwitch(Protocol):
    """Takes the robot out of service; `rn_standard.ops.maintenance.MaintenanceFeature`."""

    @property
    def state(self) -> object | None:
        """Who took it out of service, as text; None in service."""
        ...

    def begin(self, who: str, role: str, reason: str) -> object:
        """Take it out of service. Raises RoboNeuronError."""
        ...

    def end(self, who: str, role: str) -> None:
        """Put it back. Raises RoboNeuronError."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class ShownTask:
    """One past task.

    Attributes:
        number: unique and lasting: its end [s since 1970] and its place among those of that second.
        at_s: its end, wall clock [s].
        instruction, outcome, reason: as of run_task.
        attempts, took_s: as of run_task; time in seconds.
        model: what the policy was started with, in words.
        pictures: whether there is one of the beginning, and of the end.
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
    """The tasks that were carried out, and pictures of them."""

    def newest(self) -> Sequence[ShownTask]:
        """Newest first. Raises OSError when they cannot be read."""
        ...

    def picture(self, number: str, *, is_end: bool) -> bytes | None:
        """JPEG of the main camera at the beginning or end of a task; None when nobody kept one.
        Blocks.
        """
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class RobotRecords:
    """Attributes:
    alarms: what went wrong.
    maintenance: None where the server has none.
    tasks: None where the server has none.
    """

    alarms: AlarmBook
    maintenance: MaintenanceSwitch | None = None
    tasks: PastTaskList | None = field(default=None)

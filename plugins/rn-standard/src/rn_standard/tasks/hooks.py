"""Hook of monitors, and their descriptor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from roboneuron import Spec, hookspec


@dataclass(frozen=True, kw_only=True, slots=True)
class MonitorSpec(Spec):
    """A detector that decides from observations if a condition is fulfilled.

    Attributes:
        cameras: roles of required frames.
        optional_cameras: roles of frames used if the robot has them.
    """

    kind: ClassVar[str] = "monitor"
    rules: ClassVar[str] = "rn_standard.tasks.contract_cases:KIND"

    cameras: tuple[str, ...] = ()
    optional_cameras: tuple[str, ...] = ()


@hookspec
def roboneuron_monitors() -> Sequence[MonitorSpec]:  # type: ignore[empty-body]
    """Offer detectors for the predicates of tasks.

    `target` follows the protocol `rn_standard.tasks.monitor.Monitor`; it is built as
    `target(config)` for each task.
    """

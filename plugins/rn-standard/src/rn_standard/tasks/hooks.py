"""Hook of monitors, and their descriptor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from roboneuron import Spec, hookspec


@dataclass(frozen=True, kw_only=True, slots=True)
class MonitorSpec(Spec):
    """A detector that decides from observations if a condition is fulfilled, or a task done.

    Attributes:
        cameras: roles of required frames.
        optional_cameras: roles of frames used if the robot has them.
        limit_s: longest time of one answer [s]. A monitor with more than 0.05 s is asked in a
            thread of its own: it never delays a task, and an answer that is late does not count.
        in_predicates: an agent may name it in a predicate; False for one that only the
            configuration may choose, because its options reach other machines, files or programs.
    """

    kind: ClassVar[str] = "monitor"
    rules: ClassVar[str] = "rn_standard.tasks.contract_cases:KIND"

    cameras: tuple[str, ...] = ()
    optional_cameras: tuple[str, ...] = ()
    limit_s: float = 0.05
    in_predicates: bool = True


@hookspec
def roboneuron_monitors() -> Sequence[MonitorSpec]:  # type: ignore[empty-body]
    """Offer detectors for the predicates of tasks, and monitors that watch whole tasks.

    `target` follows the protocol `rn_standard.tasks.monitor.Monitor`; it is built as
    `target(config)` for each task. `[tasks.monitor]` of the configuration names the one that
    watches every task.
    """

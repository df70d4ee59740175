"""What the supervisor tells about modules."""

from __future__ import annotations

from dataclasses import dataclass

from roboneuron.modules.settings import ModuleKind
from roboneuron.supervisor.health import Report
from roboneuron.supervisor.process import ModuleProcess
from roboneuron.supervisor.slot import Choice, Exit, Phase


@dataclass(frozen=True, kw_only=True, slots=True)
class ModuleView:
    """What is known of one module.

    Attributes:
        kind, phase: which one, and what the supervisor is doing with it.
        process: None when there is none.
        choice: what it was started with.
        report: its newest status, None before the first.
        exit: how it ended by itself.
    """

    kind: ModuleKind
    phase: Phase
    process: ModuleProcess | None = None
    choice: Choice | None = None
    report: Report | None = None
    exit: Exit | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Stopped:
    """How a stop went.

    Attributes:
        killed: SIGKILL was needed.
        took_s: from the call to the process reaped.
        report: the last one that came.
    """

    kind: ModuleKind
    pid: int
    exit_code: int
    killed: bool
    took_s: float
    report: Report | None = None

"""Reports on the effect of control's limits, in its status and in the audit; `join` is called in
every module process.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from dataclasses import fields
from pathlib import Path

from roboneuron.contract import Hold
from roboneuron.errors import RefusedError
from roboneuron.gate.audit import AuditLog, AuditRecord
from roboneuron.gate.motion import LimitedCommand
from roboneuron.modules.holding import HoldingModule
from roboneuron.modules.module_host import Module, ModuleHost
from roboneuron.modules.step_filters import StepFilter

_RECORD_PERIOD_S = 1.0
"""Period of audit records of a limit that keeps acting; every change is recorded at once, at most
ten a second.
"""
_CHANGE_PERIOD_S = 0.1
"""Least time between records of changes: a command at the edge of a limit may change the acting
limit with each message.
"""
_TOLD = {
    "step_m": "step_m",
    "step_rad": "step_rad",
    "speed_m_s": "speed_m_s",
    "joint_speed": "joint_speed",
    "smallest_singular_value": "singular_value",
}
"""Numbers of a motion by their names in the status."""
Numbers = dict[str, dict[str, float]]
"""Numbers of a command as requested and as sent."""
log = logging.getLogger(__name__)


def join(host: ModuleHost) -> None:
    """See `FeatureSpec.on_join`."""
    if host.settings.kind == "control":
        host.on_configured.append(_extend)


def _extend(module: Module) -> None:
    if isinstance(module, HoldingModule):
        reports = LimitReports(module)
        module.filters.add(reports)
        module.node.resources.callback(reports.close)


class LimitReports(StepFilter):
    """Counts and records the effects of one control's limits; used on the executor's thread.

    The status contains `asked_*` and `sent_*`, the number of actions of each limit as
    `limited.<name>`, and the last one as `limit`.
    """

    def __init__(self, control: HoldingModule) -> None:
        self._robot = control.profile.name
        self._status = control.status
        directory = Path(control.node.settings.state_directory)
        self._audit = AuditLog.in_directory(directory, time.time_ns)
        self.close = self._audit.close
        self._counts: Counter[str] = Counter()
        self._recorded: tuple[str, ...] = ()
        self._recorded_s = 0.0

    def note_limited(self, limited: LimitedCommand) -> None:
        """Report the effect of the limits on one command."""
        numbers = _numbers(limited)
        for word, motion in numbers.items():
            for name, value in motion.items():
                if name in _TOLD:
                    self._status.set_value(f"{word}_{_TOLD[name]}", value)
        self._status.set_value("sent_share", limited.share)
        for name in limited.acted:
            self._count(name, f"limited.{name}")
        if limited.reference_lost:
            self._count("reference_lost", "reference_lost")
        if limited.reason:
            self._status.set_value("limit", limited.reason)
            self._record(limited, numbers, time.monotonic())

    def _count(self, name: str, key: str) -> None:
        self._counts[name] += 1
        self._status.set_value(key, self._counts[name])

    def _record(self, limited: LimitedCommand, numbers: Numbers, now_s: float) -> None:
        """Write one audit record when the limits begin to act, change, or keep acting."""
        outcome = _outcome(limited)
        state = (outcome, *limited.acted)
        period_s = _CHANGE_PERIOD_S if state != self._recorded else _RECORD_PERIOD_S
        if now_s - self._recorded_s < period_s:
            return
        self._recorded, self._recorded_s = state, now_s
        held = limited.command.code if isinstance(limited.command, Hold) else ""
        arguments: dict[str, object] = {
            word: {name: round(value, 6) for name, value in motion.items()}
            for word, motion in numbers.items()
        }
        record = AuditRecord(
            who="control",
            role="",
            tool="action",
            verdict=outcome,
            robot=self._robot,
            endpoint="action",
            rule=", ".join(limited.acted) or held,
            reason=limited.reason,
            arguments=arguments | {"counts": dict(self._counts)},
        )
        try:
            self._audit.write(record)
        except RefusedError as error:
            self._status.drop("unrecorded")
            log.error("%s", error)


def _numbers(limited: LimitedCommand) -> Numbers:
    """The computed numbers."""
    numbers: Numbers = {}
    for word, motion in (("asked", limited.asked), ("sent", limited.sent)):
        if motion is None:
            continue
        # not `asdict`, because that copies each number (50 us)
        values = {field.name: getattr(motion, field.name) for field in fields(motion)}
        numbers[word] = {name: value for name, value in values.items() if value is not None}
    return numbers


def _outcome(limited: LimitedCommand) -> str:
    if limited.command is None:
        return "refused"
    return "held" if isinstance(limited.command, Hold) else "scaled"

"""One module in the place of another: warm or cold, with a way back."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from roboneuron.errors import RoboNeuronError, StateError
from roboneuron.modules.settings import ModuleKind
from roboneuron.server.selection import Selection
from roboneuron.server.switching import ARRIVAL_S, Change, WarmSwitch
from roboneuron.server.trials import Trial
from roboneuron.supervisor.health import Report
from roboneuron.supervisor.launching import Stage
from roboneuron.supervisor.supervisor import Supervisor
from roboneuron.supervisor.view import ModuleView

SwitchMode = Literal["warm", "cold"]
_FIRST_S = 3.0
"""A newcomer hears of the next input within this time, on a busy machine too."""
Start = Callable[[ModuleKind, Selection, Stage], ModuleView]


@dataclass(frozen=True, kw_only=True, slots=True)
class Switched:
    """A module that took the place of another.

    Attributes:
        view: the new one.
        replaced: what was chosen for the old one.
        change: what the change-over did to the stream of its outputs.
        took_s: the whole call, loading included.
    """

    view: ModuleView
    replaced: dict[str, str]
    mode: SwitchMode
    change: Change
    took_s: float


class Replacing:
    """Replaces modules and remembers what was there before; usable from any thread.

    Args:
        start: starts a module where there is none.
    """

    def __init__(self, supervisor: Supervisor, start: Start) -> None:
        self._supervisor = supervisor
        self._start = start
        self._before: dict[ModuleKind, Selection] = {}

    def before(self, kind: ModuleKind, noun: str) -> Selection:
        """What was there before the last replacement.

        Raises:
            StateError: there was none.
        """
        selection = self._before.get(kind)
        if selection is None:
            raise StateError(f"There is no {noun} to go back to: none was replaced yet.")
        return selection

    def replace(
        self, old: ModuleView, selection: Selection, trial: Trial, mode: SwitchMode, on_stage: Stage
    ) -> Switched:
        """Put `selection` in the place of `old`.

        Raises:
            RoboNeuronError: warm, nothing was replaced; cold, nothing of that kind runs any more.
        """
        assert old.choice is not None
        started_s = time.monotonic()
        config = old.choice.settings.config
        section = getattr(config, old.kind)
        python = section.python if section is not None else None
        replaced = Selection(config=config, names=old.choice.names, python=python)
        if mode == "warm":
            change = WarmSwitch(self._supervisor, selection, trial, on_stage).run()
        else:
            change = self._cold(replaced, selection, trial, on_stage)
        self._before[old.kind] = replaced
        return Switched(
            view=self._supervisor.view(old.kind),
            replaced=dict(replaced.names),
            mode=mode,
            change=change,
            took_s=time.monotonic() - started_s,
        )

    def _cold(self, replaced: Selection, selection: Selection, trial: Trial, on_stage: Stage) -> Change:
        """Stop the old one, then start the new one: for a machine, or a device, that has no room for two."""
        kind = trial.kind
        due = trial.is_due()
        on_stage(f"{kind}: stopping the old {trial.noun}")
        stopped = self._supervisor.stop(kind)
        last = stopped.report if stopped is not None else None
        try:
            self._start(kind, selection, on_stage)
        except RoboNeuronError as error:
            before = ", ".join(f"{key} {name!r}" for key, name in replaced.names.items())
            error.hint = f"{error.hint} No {trial.noun} is running now; before there was {before}.".strip()
            raise
        changes = self._supervisor.changes
        if due:  # a start is complete before the first output where that waits for somebody else's
            changes.wait_for(lambda: (new := self._newest(kind)) is not None and trial.has_taken_over(new), _FIRST_S)
        gap = changes.wait_for(lambda: trial.measure(last, self._newest(kind)), ARRIVAL_S)
        return Change(gap=gap, difference=None)

    def _newest(self, kind: ModuleKind) -> Report | None:
        return self._supervisor.view(kind).report

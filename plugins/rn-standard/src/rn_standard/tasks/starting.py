"""Parallel start of all modules; a failure of one ends the others."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from roboneuron import Arguments, NotReadyError, RoboNeuronError, StateError
from roboneuron.feature import (
    ClosedLoop,
    ModuleKind,
    Modules,
    ModuleView,
    Plan,
    Stage,
)
from roboneuron.selection.requests import StartChosenInference


@dataclass(frozen=True, kw_only=True, slots=True)
class StartedModules:
    """Result of one call of start_all.

    Attributes:
        views: the started modules, in the order of `Modules.slots`.
        took_s: time from the call to the readiness of each.
        already: modules that were running before.
        total_s: duration of the whole call.
    """

    views: tuple[ModuleView, ...]
    took_s: dict[ModuleKind, float]
    already: tuple[ModuleKind, ...]
    total_s: float


class ParallelStart:
    """One start of all configured modules that are not running; used once.

    All modules are checked before the first is spawned. Then each is started on a separate thread,
    and waits by itself for its inputs from the others. The first failure cancels the other starts,
    and stops modules that have started.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        modules: Modules,
        requests: dict[ModuleKind, Arguments],
        role: str,
    ) -> None:
        """Args:
        loop, modules: those of the server.
        requests: the caller's requests by kind; other kinds start as configured.
        role: role of the caller.
        """
        self._loop = loop
        self._modules = modules
        self._requests = requests
        self._role = role
        # guards the first failure: a module that has not begun to start then never does
        self._lock = threading.Lock()
        self._failure: RoboNeuronError | None = None
        self._halt = threading.Event()  # set with the failure
        self._took_s: dict[ModuleKind, float] = {}
        self._kinds: tuple[ModuleKind, ...] = ()

    def run(self, on_stage: Stage) -> StartedModules:
        """Start; returns when every module has passed its readiness check.

        Raises:
            StateError: everything runs already, so that a model or instruction cannot be applied; a
                module is being started or stopped; or the start was cancelled.
            RoboNeuronError: as `ClosedLoop.start`, from the module that failed first; everything
                started by this call is stopped.
        """
        began_s = time.monotonic()
        phases = {kind: self._modules.view(kind).phase for kind in self._modules.slots}
        if busy := [
            f"{kind} is {phase}"
            for kind, phase in phases.items()
            if phase in ("starting", "stopping")
        ]:
            raise StateError(
                f"{', '.join(busy)}: by another call, or the server restarts what has failed.",
                hint="Call again in some seconds; get_status tells when that has ended.",
            )
        already = tuple(kind for kind, phase in phases.items() if phase == "running")
        wanted = [kind for kind in phases if kind not in already and self._is_configured(kind)]
        if not wanted:
            if self._requests:
                raise StateError(
                    "Everything that is configured runs already.",
                    hint="Change the instruction by set_instruction, the model by "
                    "switch_inference.",
                )
            took_s = time.monotonic() - began_s
            return StartedModules(views=(), took_s={}, already=already, total_s=took_s)
        plans = [self._loop.select(kind, self._requests.get(kind), self._role) for kind in wanted]
        # Conditions that a start would wait for alone are checked first: a module gives up if an
        # input's module is not even starting.
        self._loop.emergency_stop.prepare(self._loop.config.namespace)
        if "inference" in wanted:
            self._loop.stream(self._loop.config.namespace)
        with self._lock:
            self._check()
            self._kinds = tuple(wanted)
        threads = [
            threading.Thread(
                target=self._start,
                args=(plan, on_stage, began_s),
                name=f"start-{plan.kind}",
            )
            for plan in plans
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if self._failure is not None:
            self._undo(on_stage)
            raise self._failure
        views = tuple(self._modules.view(kind) for kind in wanted)
        return StartedModules(
            views=views, took_s=self._took_s, already=already, total_s=time.monotonic() - began_s
        )

    def cancel(self) -> None:
        """Cancel the starts in progress; callable from any thread. `run` then stops the started
        modules, and raises.
        """
        self._fail(StateError("The start was cancelled: the client cancelled the call."))

    def _is_configured(self, kind: ModuleKind) -> bool:
        return kind in self._requests or kind in self._loop.config.module_kinds

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _start(self, plan: Plan, on_stage: Stage, began_s: float) -> None:
        try:
            with self._lock:
                self._check()
            self._loop.start_selected(plan, on_stage, self._halt)
        except RoboNeuronError as error:
            self._fail(error)
        except BaseException as error:  # a thread's border; the others must end too
            self._fail(NotReadyError(f"{plan.kind} failed to start: {error!r}."))
            raise
        else:
            self._took_s[plan.kind] = time.monotonic() - began_s
            on_stage(f"{plan.kind}: works ({len(self._took_s)} of {len(self._kinds)})")
            if self._failure is not None:  # cancelled after the last check of the start itself
                self._stop(plan.kind)

    def _fail(self, error: RoboNeuronError) -> None:
        with self._lock:
            self._failure = self._failure or error
        self._halt.set()

    def _undo(self, on_stage: Callable[[str], None]) -> None:
        for kind in reversed(self._kinds):
            if kind in self._took_s and self._modules.view(kind).phase == "running":
                on_stage(f"{kind}: stopping it again")
                self._stop(kind)

    def _stop(self, kind: ModuleKind) -> None:
        with suppress(StateError):  # stopped by another client
            self._loop.stop(kind)


def requests_for(
    instruction: str | None, model: StartChosenInference | None = None
) -> dict[ModuleKind, Arguments]:
    """Requests of start_all to inference: a model, and an instruction for it."""
    if instruction is None and model is None:
        return {}
    request = model or StartChosenInference(options={})
    if instruction is not None:
        request = request.model_copy(update={"instruction": instruction})
    return {"inference": request}

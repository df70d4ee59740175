"""Restarts of modules after failures: conditions, limits and delays."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rn_standard.ops.options import OpsOptions
from roboneuron import RoboNeuronError
from roboneuron.feature import (
    ClosedLoop,
    Config,
    Health,
    ModuleKind,
    ModuleView,
)

OVERLOADED = 2.0
"""Runnable tasks per core from which a module may be late without a fault: it gets half a core."""
_LOADAVG = Path("/proc/loadavg")


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def runnable_per_core(source: Path = _LOADAVG) -> float:
    """Number of tasks that run or wait for a core at this moment, per core; 0 if unknown.

    Source: proc(5), the fourth field of /proc/loadavg. The averages before it are over a minute and
    more, which is too slow.
    """
    try:
        running = int(source.read_text(encoding="ascii").split()[3].partition("/")[0])
    except (OSError, ValueError, IndexError):
        return 0.0
    return (running - 1) / cores()  # one of them is this thread


log = logging.getLogger(__name__)
_FROZEN: frozenset[Health] = frozenset({"silent", "stuck", "stalled"})
_LOOK_S = 0.05
_SAMPLES = 5
"""Samples of the load before a restart: a quarter of a second."""
_FROZEN_SAMPLES = 20
"""Samples of the load while a module is frozen: the last second."""
_PATIENCE = 5.0
"""Factor on `unresponsive_s` for a frozen module while the machine is overloaded."""
_HOUR_S = 3600.0
_LONGEST_S = 60.0
"""Longest delay of a restart on an overloaded machine, where starting a process delays all others
further.
"""
_RELIEF = "stop other programs, or use fewer cameras, a lower rate or a smaller image"
Record = Callable[[ModuleKind, str], None]
"""Called with the restarted module and the result."""


class Restarts:
    """Restarts modules that ended or froze, if `[ops.restart]` is "on_failure".

    A faulty module has a limit of restarts within a window; the delay doubles with every restart in
    that window. While the machine is overloaded the cause is unclear: a frozen module gets more
    time, restarts are delayed further, and a separate limit per hour applies. A module is ended
    after it was frozen for `unresponsive_s`. A requested start resets all counts.

    A restart sets nothing in motion: the policy has no instruction afterwards, and robot and
    control refuse commands until motion is requested.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        options: OpsOptions,
        record: Record,
        before: Callable[[ModuleKind], object] = lambda kind: None,
        load: Callable[[], float] = runnable_per_core,
    ) -> None:
        """Args:
        loop, options: those of the server.
        record: called with every restart.
        before: called right before a restart, which must set nothing in motion.
        load: returns the runnable tasks per core.
        """
        self._modules = loop.modules
        self._loop = loop
        self._before = before
        self._options = options
        self._record = record
        self._load = load
        # one pending restart for each kind; the restart itself runs without the lock, so that it
        # can be cancelled
        self._lock = threading.Lock()
        self._faults: defaultdict[ModuleKind, deque[float]] = defaultdict(deque)
        self._overloads: defaultdict[ModuleKind, deque[float]] = defaultdict(deque)
        self._pending: dict[ModuleKind, threading.Event] = {}
        self._closed = False

    def on_health(self, view: ModuleView, before: Health, health: Health) -> None:
        """Listener of `Watch`; schedules restarts."""
        if health == "starting":
            self._begin_anew(view.kind)
        if health != "exited" and health not in _FROZEN:
            return
        if view.plan is None or self._options.restart.policy(view.kind) != "on_failure":
            return
        with self._lock:
            if self._closed or view.kind in self._pending:
                return
            self._pending[view.kind] = threading.Event()
        threading.Thread(
            target=self._restart, args=(view,), name=f"restart-{view.kind}", daemon=True
        ).start()

    def _begin_anew(self, kind: ModuleKind) -> None:
        """Reset the counts, unless the start is a restart."""
        with self._lock:
            if kind not in self._pending:
                self._faults[kind].clear()
                self._overloads[kind].clear()

    def cancel(self, kind: ModuleKind) -> bool:
        """Cancel a pending restart after another decision; return True if there was one."""
        with self._lock:
            pending = self._pending.get(kind)
        if pending is not None:
            pending.set()
        return pending is not None

    def close(self) -> None:
        """Stop all restarts; idempotent."""
        with self._lock:
            self._closed = True
            pending = list(self._pending.values())
        for event in pending:
            event.set()

    def _restart(self, view: ModuleView) -> None:
        kind = view.kind
        cancelled = self._pending[kind]
        try:
            self._attempt(view, cancelled)
        except RoboNeuronError as error:
            self._record(kind, f"restart failed: {error.message}")
        finally:
            with self._lock:
                del self._pending[kind]

    def _attempt(self, view: ModuleView, cancelled: threading.Event) -> None:
        assert view.plan is not None
        kind, plan = view.kind, view.plan
        if view.phase == "running" and not self._is_still_frozen(
            view, cancelled, self._options.unresponsive_s
        ):
            return
        while (load := self._measured_load(cancelled)) is not None:
            delay_s = self._delay_s(kind, load)
            if delay_s is None:
                return
            if view.phase == "running" and self._modules.view(kind).phase == "running":
                self._loop.end(kind)
            if cancelled.wait(delay_s):
                return
            if self._modules.view(kind).phase not in ("exited", "stopped"):
                return
            try:
                self._before(kind)
                config = without_instruction(plan.config)
                self._loop.launch(replace(plan, config=config))
            except RoboNeuronError as error:
                self._record(kind, f"restart failed: {error.message}")
                continue
            advice = f"; {_overload(load)}: {_RELIEF}" if load >= OVERLOADED else ""
            self._record(kind, f"restarted after {delay_s:g} s{advice}")
            return

    def _delay_s(self, kind: ModuleKind, load: float) -> float | None:
        """Count one more restart and return its delay [s]; None, with a record, if there were too
        many.
        """
        rules, now_s = self._options, time.monotonic()
        is_overloaded = load >= OVERLOADED
        history = self._overloads[kind] if is_overloaded else self._faults[kind]
        window_s = _HOUR_S if is_overloaded else rules.restart_window_s
        limit = rules.overload_restart_limit if is_overloaded else rules.restart_limit
        while history and now_s - history[0] > window_s:
            history.popleft()
        if len(history) >= limit:
            why = (
                f"{_overload(load)}. First {_RELIEF}"
                if is_overloaded
                else "get_logs tells why. Mend the cause"
            )
            count = f"{len(history)} restarts within {window_s:g} s"
            self._record(kind, f"not restarted: {count}; {why}, then call start_{kind}")
            return None
        delay_s = rules.restart_backoff_s * 2 ** len(history)
        history.append(now_s)
        return float(min(delay_s * 2, _LONGEST_S) if is_overloaded else delay_s)

    def _measured_load(self, cancelled: threading.Event) -> float | None:
        """Mean load over a quarter of a second; None if the restart was cancelled meanwhile."""
        samples = []
        for _ in range(_SAMPLES):
            samples.append(self._load())
            if cancelled.wait(_LOOK_S):
                return None
        return sum(samples) / len(samples)

    def _is_still_frozen(
        self, view: ModuleView, cancelled: threading.Event, bound_s: float
    ) -> bool:
        """True if the module stays frozen for `bound_s`, or longer while the machine is
        overloaded.
        """
        began_s = time.monotonic()
        samples: deque[float] = deque(maxlen=_FROZEN_SAMPLES)
        while True:
            samples.append(self._load())
            is_overloaded = sum(samples) / len(samples) >= OVERLOADED
            if time.monotonic() - began_s >= bound_s * (_PATIENCE if is_overloaded else 1.0):
                return True
            if cancelled.wait(_LOOK_S):
                return False
            now = self._modules.view(view.kind)
            if now.process is not view.process or now.health(time.monotonic()) not in (
                *_FROZEN,
                "exited",
            ):
                return False


def without_instruction(config: Config) -> Config:
    """Return the configuration without an instruction, so that the policy waits for one."""
    if config.inference is None:
        return config
    return config.model_copy(
        update={"inference": config.inference.model_copy(update={"instruction": ""})}
    )


def _overload(load: float) -> str:
    return f"the machine is overloaded ({load * cores():.0f} tasks for {cores()} cores)"

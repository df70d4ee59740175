"""Restarts of modules after failures: which, how often, and how soon."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable

from rn_ops.options import OpsOptions
from roboneuron import RoboNeuronError
from roboneuron.modules.settings import MODULE_KINDS, ModuleKind
from roboneuron.supervisor.health import Health, ModuleView, assess
from roboneuron.supervisor.supervisor import Supervisor

log = logging.getLogger(__name__)
_FROZEN: frozenset[Health] = frozenset({"silent", "stuck", "stalled"})
Record = Callable[[ModuleKind, str], None]
"""Told what was restarted, and how that went."""


class Restarts:
    """Starts modules again that ended or froze, where `[ops.restart]` says "on_failure".

    Each has a limit within a window; the wait before a restart doubles with every restart in that window. A module that
    is frozen is ended first, once it has been so for `unresponsive_s`.
    """

    def __init__(self, supervisor: Supervisor, options: OpsOptions, record: Record) -> None:
        self._supervisor = supervisor
        self._options = options
        self._record = record
        self._lock = threading.Lock()
        self._history: dict[ModuleKind, deque[float]] = {kind: deque() for kind in MODULE_KINDS}
        self._pending: dict[ModuleKind, threading.Event] = {}
        self._closed = False

    def on_health(self, view: ModuleView, before: Health, health: Health) -> None:
        """Listener of `Watch`."""
        if health != "exited" and health not in _FROZEN:
            return
        if view.choice is None or self._options.restart.policy(view.kind) != "on_failure":
            return
        with self._lock:
            if self._closed or view.kind in self._pending:
                return
            self._pending[view.kind] = threading.Event()
        threading.Thread(target=self._restart, args=(view,), name=f"restart-{view.kind}", daemon=True).start()

    def cancel(self, kind: ModuleKind) -> bool:
        """Somebody decides otherwise; returns whether a restart was pending."""
        with self._lock:
            pending = self._pending.get(kind)
        if pending is not None:
            pending.set()
        return pending is not None

    def close(self) -> None:
        """No more restarts; idempotent."""
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
        assert view.choice is not None
        kind, config, rules = view.kind, view.choice.settings.config, self._options
        if view.phase == "running" and not self._is_still_frozen(view, cancelled, rules.unresponsive_s):
            return
        history = self._history[kind]
        while True:
            now_s = time.monotonic()
            while history and now_s - history[0] > rules.restart_window_s:
                history.popleft()
            if len(history) >= rules.restart_limit:
                self._record(kind, f"not restarted: {len(history)} restarts within {rules.restart_window_s:g} s")
                return
            delay_s = rules.restart_backoff_s * 2 ** len(history)
            history.append(now_s)
            if view.phase == "running" and self._supervisor.view(kind).phase == "running":
                self._supervisor.stop(kind)
            if cancelled.wait(delay_s):
                return
            if self._supervisor.view(kind).phase not in ("exited", "stopped"):
                return
            try:
                section = getattr(config, kind)
                self._supervisor.start(
                    kind,
                    config,
                    python=section.python if section else None,
                    names=view.choice.names,
                    plan=view.choice.plan,
                )
            except RoboNeuronError as error:
                self._record(kind, f"restart failed: {error.message}")
                continue
            self._record(kind, f"restarted after {delay_s:g} s")
            return

    def _is_still_frozen(self, view: ModuleView, cancelled: threading.Event, bound_s: float) -> bool:
        deadline_s = time.monotonic() + bound_s
        while time.monotonic() < deadline_s:
            if cancelled.wait(0.05):
                return False
            now = self._supervisor.view(view.kind)
            if now.process is not view.process or assess(now, time.monotonic()) not in (*_FROZEN, "exited"):
                return False
        return True

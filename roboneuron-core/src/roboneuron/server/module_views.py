"""The processes of the modules, as everything in the server and its features may read them."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from roboneuron.modules.settings import ModuleKind
from roboneuron.supervisor.changes import Changes
from roboneuron.supervisor.health import ModuleView
from roboneuron.supervisor.process import ModuleProcess, ProcessEvents


class Modules(Protocol):
    """The processes of the modules, as features may read them and be told of them.

    Attributes:
        log_directory: where this server's modules log, one file for each.
        changes: told of all that happens to modules, for waiting.
        process_events: what happens to module processes, for listeners.
        secret_variables: environment variables that modules do not get; features may add some.
    """

    log_directory: Path
    changes: Changes
    process_events: ProcessEvents
    secret_variables: set[str]

    def view(self, kind: ModuleKind) -> ModuleView:
        """What is known of a module now."""

    def views(self) -> list[ModuleView]:
        """All modules, in the order robot, perception, inference, control."""

    def processes(self, kind: ModuleKind) -> list[ModuleProcess]:
        """Those of a kind: of the module that works, and of one that is to replace it."""

    def require_running(self, kind: ModuleKind) -> ModuleView:
        """The view of a running module. Raises StateError when it is not running."""

    def log_path(self, kind: ModuleKind) -> Path:
        """Where the present module of that kind logs."""

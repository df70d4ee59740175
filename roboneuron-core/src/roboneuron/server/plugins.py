"""The installed plugins as the server sees them: read again when something was installed or
removed.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection

from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Registry


class PluginCatalogue:
    """The registry of plugins; discovery keeps it until a folder of the import path has changed."""

    def __init__(
        self,
        disabled: Collection[str] = (),
        discover: Callable[[Collection[str]], Registry] = discover,
    ) -> None:
        self._disabled = tuple(disabled)
        self._discover = discover
        # two threads that import plugins at once would take stdout from each other
        self._lock = threading.Lock()
        self._registry: Registry | None = None

    @property
    def latest(self) -> Registry:
        """The registry as it was read last: for what every answer tells. Raises as `current`."""
        return self._registry or self.current()

    def current(self) -> Registry:
        """The registry of what is installed now; callable from any thread.

        Raises:
            ConfigurationError: the configuration disables a plugin that is not installed.
        """
        with self._lock:
            self._registry = self._discover(self._disabled)
            return self._registry

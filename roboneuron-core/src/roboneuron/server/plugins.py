"""The installed plugins as the server sees them: read again when something was installed or
removed.
"""

from __future__ import annotations

import importlib
import os
import sys
import threading
from collections.abc import Callable, Collection

from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Registry


class PluginCatalogue:
    """The registry of plugins, discovered on first use and whenever a folder of the import path has
    changed.
    """

    def __init__(
        self,
        disabled: Collection[str] = (),
        discover: Callable[[Collection[str]], Registry] = discover,
    ) -> None:
        self._disabled = tuple(disabled)
        self._discover = discover
        self._lock = threading.Lock()
        self._registry: Registry | None = None
        self._seen: tuple[int, ...] = ()

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
            now = _fingerprint()
            if self._registry is None or now != self._seen:
                importlib.invalidate_caches()
                self._registry, self._seen = self._discover(self._disabled), now
            return self._registry


def _fingerprint() -> tuple[int, ...]:
    """Modification times of the folders in which packages are installed."""
    times = []
    for entry in sys.path:
        if entry.endswith(("site-packages", "dist-packages")):
            try:
                times.append(os.stat(entry).st_mtime_ns)
            except OSError:
                times.append(0)
    return tuple(times)

"""The feature: the chosen locator, built on first use."""

from __future__ import annotations

import threading
from typing import cast

from rn_standard.sight.hooks import LocatorSpec
from rn_standard.sight.locator import Locator
from rn_standard.sight.options import SightOptions
from roboneuron import Feature
from roboneuron.feature import Config, Registry, build


class Sight(Feature[SightOptions]):
    """Offers the configured locator to the tools that find objects."""

    def __init__(self, options: SightOptions) -> None:
        super().__init__(options)
        self._lock = threading.Lock()
        self._locator: Locator | None = None

    def locator(self, config: Config, registry: Registry) -> Locator:
        """The loaded locator; from any thread.

        Raises:
            ConfigurationError, MissingDependencyError, PluginError: it cannot be used.
        """
        with self._lock:
            if self._locator is None:
                spec = registry.get(LocatorSpec, self.options.locator)
                locator = cast("Locator", build(spec, config.options(spec.name)))
                locator.load()
                self._locator = locator
            return self._locator

    def close(self) -> None:
        """See Feature."""
        with self._lock:
            if self._locator is not None:
                self._locator.close()
            self._locator = None

"""The feature: the chosen locator, built on first use, and the tools that show what it finds."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, cast

from rn_standard.sight.cell_view import take_view
from rn_standard.sight.hooks import LocatorSpec
from rn_standard.sight.locator import Locator
from rn_standard.sight.marks import CellLook
from rn_standard.sight.options import SightOptions
from rn_standard.tools_inspect.looking import locate_tool, look_tool
from roboneuron import Feature, Host, RoboNeuronError, Tool
from roboneuron.feature import Config, ExposedEndpoint, Registry, build

_MOST_CLIENTS = 16


class Sight(Feature[SightOptions]):
    """Looks at the cell with the configured locator, for its tools and for other features."""

    def __init__(self, options: SightOptions) -> None:
        super().__init__(options)
        self._lock = threading.Lock()
        self._locator: Locator | None = None
        self._looks: OrderedDict[str, CellLook] = OrderedDict()

    def tools(self, host: Host) -> Sequence[Tool[Any]]:
        """look and locate."""
        self._host = host
        return [
            look_tool(host, self.look, self._arm),
            locate_tool(self.look, self.last_look, lambda: self.options.table_m),
        ]

    def locator(self, config: Config, registry: Registry) -> Locator:
        """The loaded locator; from any thread.

        Raises:
            ConfigurationError, MissingDependencyError, PluginError: it cannot be used.
        """
        with self._lock:
            return self._loaded(config, registry)

    def _loaded(self, config: Config, registry: Registry) -> Locator:
        if self._locator is None:
            spec = registry.get(LocatorSpec, self.options.locator)
            locator = cast("Locator", build(spec, config.options(spec.name)))
            locator.load()
            self._locator = locator
        return self._locator

    def look(self, who: str, newer_than_ns: int = 0) -> CellLook:
        """Look at the cell for a client, whose marks these become; blocks for at most a second.

        Args:
            who: the client.
            newer_than_ns: only with pictures taken later, ROS clock [ns].

        Raises:
            RoboNeuronError: ROS cannot be joined.
        """
        exposed = self._arm()
        profile = None if exposed is None else exposed.profile
        view = take_view(self._host, profile, newer_than_ns=newer_than_ns)
        failure = ""
        with self._lock:
            try:
                locator = self._loaded(self._host.config, self._host.registry)
                found = tuple(locator.locate(view.images))
            except RoboNeuronError as error:
                found, failure = (), str(error)
            objects = tuple(sorted(found, key=lambda one: tuple(one.position_m.tolist())))
            look = CellLook(view=view, objects=objects, failure=failure)
            self._looks[who] = look
            self._looks.move_to_end(who)
            if len(self._looks) > _MOST_CLIENTS:
                self._looks.popitem(last=False)
        return look

    @property
    def table_m(self) -> float:
        """Height of the table in the base frame [m]."""
        return self.options.table_m

    def last_look(self, who: str) -> CellLook | None:
        """The last look of a client."""
        with self._lock:
            return self._looks.get(who)

    def _arm(self) -> ExposedEndpoint | None:
        """An endpoint of the present robot with its profile; None without one."""
        name = self._host.config.robot.name
        exposed = self._host.gate.exposed
        return next((one for one in exposed if one.profile is not None and one.robot == name), None)

    def close(self) -> None:
        """See Feature."""
        with self._lock:
            if self._locator is not None:
                self._locator.close()
            self._locator = None

"""The feature: gives tools and tasks the clock of a simulation that waits for commands."""

from __future__ import annotations

from collections.abc import Sequence

from rn_eval_stepped.world import SteppedWorld
from rn_eval_stepped.world_clock import is_stepped
from roboneuron import Feature, Host, Tool


class SteppedTimeFeature(Feature[None]):
    """Offers the clock where the present robot has the option `stepped`."""

    _host: Host | None = None

    def __init__(self, options: None) -> None:
        super().__init__(options)
        # by namespace: a clock keeps its subscription
        self._worlds: dict[str, SteppedWorld] = {}

    def tools(self, host: Host) -> Sequence[Tool]:
        """See `Feature.tools`: none."""
        self._host = host
        return ()

    def clock(self, namespace: str) -> SteppedWorld | None:
        """See `Feature.clock`."""
        host = self._host
        if host is None or namespace != host.config.namespace or not is_stepped(host.config):
            return None
        return self._worlds.setdefault(namespace, SteppedWorld(host, namespace))

"""The feature: a server starts only if its link works."""

from __future__ import annotations

import logging
import os
from datetime import UTC, datetime, timedelta

from rn_link.environment import check_unopposed, uses_link
from rn_link.keeper import RelayKeeper
from rn_link.machine import Machine, link_folder, read_machine
from rn_link.options import LinkOptions
from roboneuron import ConfigurationError, Feature, Host
from roboneuron.feature import Config

log = logging.getLogger(__name__)


class LinkFeature(Feature[LinkOptions]):
    """Checks keys and certificates; the link itself is the environment of the processes."""

    def __init__(self, options: LinkOptions) -> None:
        super().__init__(options)
        self._keeper: RelayKeeper | None = None

    def check(self, config: Config) -> None:
        """Check that the link of this machine works, and warn of certificates that expire soon.

        Raises:
            ConfigurationError: it does not work, or it is missing and the configuration requires
                it.
        """
        folder = link_folder()
        machine = read_machine(folder)
        if machine is None or not machine.peers:
            if self.options.required:
                raise ConfigurationError(
                    "No other machine is paired with this one, and [link] requires it.",
                    hint="Pair one with `roboneuron link init` and `roboneuron link add NAME`.",
                )
            return
        check_unopposed(os.environ, folder)
        self._check_dates(machine)

    def start(self, host: Host) -> None:
        """Keep the relay of this machine running."""
        if uses_link():
            self._keeper = RelayKeeper(link_folder())
            self._keeper.start()

    def close(self) -> None:
        """Stop keeping the relay; other processes that use the link restart it."""
        if self._keeper is not None:
            self._keeper.close()

    def _check_dates(self, machine: Machine) -> None:
        from rn_link.certificates import check_in_time, expiries  # heavy

        now = datetime.now(UTC)
        folder = link_folder()
        check_in_time(machine, folder, now)
        for name, expiry in expiries(machine, folder).items():
            if expiry - now < timedelta(days=self.options.warn_days):
                log.warning("The certificate of %s expires on %s.", name, f"{expiry:%Y-%m-%d}")

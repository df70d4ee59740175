"""The feature: a server starts only if its link works."""

from __future__ import annotations

import os

from rn_link.environment import check_unopposed, uses_link, write_profile
from rn_link.keeper import RelayKeeper
from rn_link.machine import link_folder, read_machine
from rn_link.tls import tls_context
from roboneuron import Feature, Host
from roboneuron.feature import Config


class LinkFeature(Feature[None]):
    """Checks this machine's keys; the link itself is the environment of the processes."""

    def __init__(self, options: None) -> None:
        super().__init__(options)
        self._keeper = RelayKeeper()

    def check(self, config: Config) -> None:
        """Check that this machine can use its link, if it has one.

        Raises:
            ConfigurationError: it cannot.
        """
        folder = link_folder()
        machine = read_machine(folder)
        if machine is not None and machine.peers:
            check_unopposed(os.environ, folder)
            write_profile(folder)
            for name in machine.peers:
                tls_context(machine, folder, name)

    def start(self, host: Host) -> None:
        """Keep a relay running on this machine."""
        if uses_link():
            self._keeper.start()

    def close(self) -> None:
        """Stop the relay; those of other processes that use the link follow."""
        self._keeper.close()

"""The feature: a server starts only if its link works."""

from __future__ import annotations

import os

from pydantic import Field

from rn_link.environment import check_unopposed, uses_link
from rn_link.keeper import RelayKeeper
from rn_link.machine import link_folder, read_machine
from rn_link.tls import own_context
from roboneuron import ConfigurationError, Feature, Host, Section
from roboneuron.feature import Config


class LinkOptions(Section):
    """`[link]`: the encrypted link between machines."""

    required: bool = Field(
        default=False, description="start the server only if another machine is paired"
    )


class LinkFeature(Feature[LinkOptions]):
    """Checks this machine's key; the link itself is the environment of the processes."""

    def __init__(self, options: LinkOptions) -> None:
        super().__init__(options)
        self._keeper: RelayKeeper | None = None

    def check(self, config: Config) -> None:
        """Check that this machine can use its link.

        Raises:
            ConfigurationError: it cannot, or it has none and the configuration requires one.
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
        try:
            own_context(machine, folder)
        except OSError as error:  # includes TLS errors
            raise ConfigurationError(
                f"The key of this machine's link is not used: {error}.",
                hint=f"Check own.key and own.pem in {folder}, or pair the machine again.",
            ) from error

    def start(self, host: Host) -> None:
        """Keep the relay of this machine running."""
        if uses_link():
            self._keeper = RelayKeeper(link_folder())
            self._keeper.start()

    def close(self) -> None:
        """Stop keeping the relay; other processes that use the link restart it."""
        if self._keeper is not None:
            self._keeper.close()

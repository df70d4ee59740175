"""The command `roboneuron shared-model`."""

from __future__ import annotations

import logging
from argparse import ArgumentParser, Namespace
from pathlib import Path


class SharedModelCommand:
    """Serve the model of [plugins.shared] in this process until Ctrl-C or SIGTERM.

    Optional: the first robot starts a server automatically. Use it under a service manager, or to
    load the model before any robot starts.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument(
            "--config", type=Path, metavar="FILE", help="a roboneuron.toml with [plugins.shared]"
        )

    def run(self, arguments: Namespace) -> int:
        """Serve."""
        from rn_backend_openpi.links import directory_of
        from rn_backend_openpi.options import PolicyOptions
        from rn_backend_openpi.plugin import SHARED
        from rn_backend_openpi.server_process import serve
        from roboneuron.command import load_config
        from roboneuron.feature import loading

        options = loading.load_options(SHARED, load_config(arguments.config).options(SHARED.name))
        assert isinstance(options, PolicyOptions)
        logging.getLogger("rn_backend_openpi").setLevel(logging.INFO)
        path = directory_of(options) / f"{options.identity()}.sock"
        return serve(options.of_the_model(), path, None)

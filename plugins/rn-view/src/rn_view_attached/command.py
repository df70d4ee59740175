"""The command `roboneuron view`."""

from __future__ import annotations

import signal
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path


class View:
    """Show the robot of a running server in a browser, from the ROS graph and its state directory.

    The server needs not know of it, and nothing is published. The page has the emergency stop, which works as
    `roboneuron estop` does, and no other button; those are on the page of a server with `[view] enabled = true`. Give
    the configuration that the server was started with: it names the robot, its namespace and the state directory.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron view`."""
        parser.add_argument("--config", type=Path, metavar="FILE", help="the server's roboneuron.toml")
        parser.add_argument("--state", type=Path, metavar="DIRECTORY", help="its state directory, if it is another")
        parser.add_argument("--host", help="address to listen on; `view.host` without it")
        parser.add_argument("--port", type=int, help="port, 0 for any free one; `view.port` without it")

    def run(self, arguments: Namespace) -> int:
        """Serve the page until Ctrl-C."""
        import os

        from rn_serve_http.options import HttpOptions
        from rn_serve_http.plugin import FEATURE as HTTP
        from rn_serve_http.tokens import TokenFiles
        from rn_view.access import Admission, host_rules
        from rn_view.options import ViewOptions
        from rn_view.plugin import FEATURE
        from rn_view.viewer import Viewer
        from rn_view_attached.source import AttachedSource
        from roboneuron.config import feature_options, load_config
        from roboneuron.plugins.discovery import discover
        from roboneuron.ros.environment import state_directory

        config = load_config(arguments.config)
        options, http = feature_options(FEATURE, config), feature_options(HTTP, config)
        assert isinstance(options, ViewOptions)
        assert isinstance(http, HttpOptions)
        given = {name: getattr(arguments, name) for name in ("host", "port") if getattr(arguments, name) is not None}
        options = ViewOptions.model_validate({**options.model_dump(), **given})
        directory = state_directory(str(arguments.state) if arguments.state else config.supervisor.state_directory)
        source = AttachedSource(config, discover(config.disabled_plugins), directory)
        admission = Admission(tokens=TokenFiles(http.tokens, os.environ), rules=host_rules(options, http))
        viewer = Viewer(options, source, admission, None)
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            source.open()
            try:
                viewer.open()
                print(f"The view is at {viewer.url}; Ctrl-C ends it.", file=sys.stderr, flush=True)
                signal.pause()
            finally:
                viewer.close()
                source.close()
        except KeyboardInterrupt:
            pass
        return 0

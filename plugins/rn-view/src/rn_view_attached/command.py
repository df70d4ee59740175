"""The command `roboneuron view`."""

from __future__ import annotations

import signal
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron import ConfigurationError, MissingDependencyError

if TYPE_CHECKING:
    from rn_view_attached.source import AttachedSource
    from rn_view_recorded.source import RecordedSource
    from roboneuron.config import Config
    from roboneuron.plugins.registry import Registry


class View:
    """Show the robot of a running server in a browser, from the ROS graph and its state directory; or a recording.

    The server needs not know of it, and nothing is published. The page has the emergency stop, which works as
    `roboneuron estop` does, and no other button; those are on the page of a server with `[view] enabled = true`. Give
    the configuration that the server was started with: it names the robot, its namespace and the state directory.

    With --run the page plays what rn-recorder has recorded, with a slider for the time. No robot and no ROS are needed.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron view`."""
        parser.add_argument("--config", type=Path, metavar="FILE", help="the server's roboneuron.toml")
        parser.add_argument("--state", type=Path, metavar="DIRECTORY", help="its state directory, if it is another")
        parser.add_argument("--robot", metavar="NAME", help="which one of several robots")
        parser.add_argument("--run", help='play a recording: its id, "latest", or a path of MCAP files')
        parser.add_argument("--directory", type=Path, help="with --run: the directory of runs itself")
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
        from roboneuron.config import feature_options, load_config
        from roboneuron.plugins.discovery import discover

        config, folder = _chosen(load_config(arguments.config), arguments.robot)
        options, http = feature_options(FEATURE, config), feature_options(HTTP, config)
        assert isinstance(options, ViewOptions)
        assert isinstance(http, HttpOptions)
        given = {name: getattr(arguments, name) for name in ("host", "port") if getattr(arguments, name) is not None}
        options = ViewOptions.model_validate({**options.model_dump(), **given})
        admission = Admission(tokens=TokenFiles(http.tokens, os.environ), rules=host_rules(options, http))
        source = _source(arguments, config, discover(config.disabled_plugins), folder)
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


def _chosen(config: Config, robot: str | None) -> tuple[Config, str]:
    """The configuration of the robot to show, and its folder in the state directory; "" for a server's only robot.

    Raises:
        ConfigurationError: there is none of that name, or there are several and none is named.
    """
    if robot is None and not config.robots:
        return config, ""
    if robot is None or robot not in config.robots:
        known = ", ".join(config.robots) or "none: the configuration has no [robots.<name>]"
        what = "Several robots can be shown." if robot is None else f"There is no robot {robot[:80]!r}."
        raise ConfigurationError(what, hint=f"--robot names one of: {known}.")
    from roboneuron.config import robot_folder

    return config.robots[robot], str(robot_folder(Path(), robot))


def _source(
    arguments: Namespace, config: Config, registry: Registry, folder: str = ""
) -> AttachedSource | RecordedSource:
    """What the page shows."""
    if arguments.run is None:
        if arguments.directory is not None:
            raise ConfigurationError("--directory goes with --run.", hint="--state names a server's state directory.")
        from rn_view_attached.source import AttachedSource
        from roboneuron.ros.environment import state_directory

        directory = state_directory(str(arguments.state) if arguments.state else config.supervisor.state_directory)
        return AttachedSource(config, registry, directory / folder)
    try:
        from rn_runs.command import find_run, open_store
    except ImportError as error:
        raise MissingDependencyError(
            "Recordings are read by rn-recorder, which is not installed.", hint="Run: pip install ./plugins/rn-recorder"
        ) from error
    from rn_view_recorded.source import RecordedSource

    run = find_run(open_store(arguments), arguments.run)
    print(f"Reading {run.id} ...", file=sys.stderr, flush=True)
    return RecordedSource(run.id, run.files, config, registry)

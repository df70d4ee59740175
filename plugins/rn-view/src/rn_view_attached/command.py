"""The command `roboneuron view`."""

from __future__ import annotations

import signal
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron import ConfigurationError, MissingDependencyError, install_command

if TYPE_CHECKING:
    from rn_view_attached.source import AttachedSource, ViewNode
    from rn_view_recorded.source import RecordedSource
    from roboneuron.feature import Config, Registry


class ViewCommand:
    """Show the robot of a running server in a browser, or play a recording.

    Reads the ROS graph and the state directory. Works beside any server and publishes nothing. The
    only button of the page is the emergency stop. Give the configuration of the server: it names
    the robot, its namespace and the state directory.

    With --run the page plays a recording of rn-recorder, with a slider for the time. This needs no
    robot and no ROS.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron view`."""
        parser.add_argument(
            "--config", type=Path, metavar="FILE", help="the server's roboneuron.toml"
        )
        parser.add_argument(
            "--state",
            type=Path,
            metavar="DIRECTORY",
            help="state directory of the server, if not as configured",
        )
        parser.add_argument("--robot", metavar="NAME", help="show only this one of several robots")
        parser.add_argument(
            "--run", help='play a recording: its id, "latest", or a path of MCAP files'
        )
        parser.add_argument("--directory", type=Path, help="with --run: directory of the runs")
        parser.add_argument("--host", help="address to listen on; default: `view.host`")
        parser.add_argument("--port", type=int, help="port, 0: any free one; default: `view.port`")

    def run(self, arguments: Namespace) -> int:
        """Serve the page until Ctrl-C."""
        import os

        from roboneuron.command import HangWatch

        watch = HangWatch()
        watch.start()
        from rn_standard.http.options import HttpOptions
        from rn_standard.http.tokens import TokenFiles
        from rn_view.options import ViewOptions
        from rn_view.plugin import FEATURE
        from rn_view.web.access import ViewAccess, host_rules
        from rn_view.web.view_server import ViewServer
        from roboneuron.command import discover, feature_options, load_config

        config = load_config(arguments.config)
        watch.bound(config.supervisor.hang_timeout_s)
        robots = _chosen(config, arguments.robot)
        if arguments.robot is not None:
            config = robots[arguments.robot]
        options, http = feature_options(FEATURE, config), HttpOptions.of(config)
        assert isinstance(options, ViewOptions)
        given = {
            name: getattr(arguments, name)
            for name in ("host", "port")
            if getattr(arguments, name) is not None
        }
        options = ViewOptions.model_validate({**options.model_dump(), **given})
        admission = ViewAccess(
            tokens=TokenFiles(http.tokens, os.environ), rules=host_rules(options, http)
        )
        known = {name: discover(one.disabled_plugins, one.robot) for name, one in robots.items()}
        source, graph = _sources(arguments, robots, known)
        viewer = ViewServer(options, source, admission, None)
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            with watch.loading():
                graph.open()
            try:
                viewer.open()
                print(
                    f"The view is at {viewer.url}; stop it with Ctrl-C.",
                    file=sys.stderr,
                    flush=True,
                )
                signal.pause()
            finally:
                viewer.close()
                graph.close()
        except KeyboardInterrupt:
            pass
        return 0


def _chosen(config: Config, robot: str | None) -> dict[str, Config]:
    """Configurations of the robots to show, by name; "" for an only robot.

    Raises:
        ConfigurationError: there is no robot of that name.
    """
    if robot is None:
        return config.robots or {"": config}
    if robot not in config.robots:
        known = ", ".join(config.robots) or "none: the configuration has no [robots.<name>]"
        raise ConfigurationError(
            f"There is no robot {robot[:80]!r}.", hint=f"--robot names one of: {known}."
        )
    return {robot: config.robots[robot]}


def _sources(
    arguments: Namespace, robots: dict[str, Config], known: Mapping[str, Registry]
) -> tuple[dict[str, AttachedSource] | RecordedSource, ViewNode | RecordedSource]:
    """Sources of the pages, and the object to open before them and close after them.

    Args:
        arguments: of the command.
        robots: configurations by name.
        known: the plugins of each.
    """
    config = next(iter(robots.values()))
    if arguments.run is not None:
        if len(robots) > 1:
            raise ConfigurationError(
                "A recording holds one robot, but the configuration has several.",
                hint=f"--robot names one of: {', '.join(robots)}.",
            )
        recorded = _recorded(arguments, config, next(iter(known.values())))
        return recorded, recorded
    if arguments.directory is not None:
        raise ConfigurationError(
            "--directory needs --run.", hint="For the state directory of a server use --state."
        )
    from rn_view_attached.source import AttachedSource, ViewNode
    from roboneuron.command import environment
    from roboneuron.feature import reading

    directory = environment.state_directory(
        str(arguments.state) if arguments.state else config.supervisor.state_directory
    )
    graph = ViewNode(directory)
    if "" in robots:
        return {"": AttachedSource(config, known[""], directory, graph)}, graph
    return {
        name: AttachedSource(
            one, known[name], reading.robot_folder(directory, name), graph, is_one_of_several=True
        )
        for name, one in robots.items()
    }, graph


def _recorded(arguments: Namespace, config: Config, registry: Registry) -> RecordedSource:
    """Source that plays a run of the recorder."""
    try:
        from rn_recorder_runs.command import find_run, open_store
    except ImportError as error:
        raise MissingDependencyError(
            "Reading recordings needs rn-recorder, which is not installed.",
            hint=f"Run: {install_command('rn-recorder')}.",
        ) from error
    from rn_view_recorded.source import RecordedSource

    run = find_run(open_store(arguments), arguments.run)
    print(f"Reading {run.id} ...", file=sys.stderr, flush=True)
    return RecordedSource(run.id, run.files, config, registry)

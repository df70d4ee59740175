"""Serve MCP tools for a robot: on stdin and stdout for the agent that starts this process, or over
HTTP for several.
"""

from __future__ import annotations

import gc
import os
import sys
from argparse import SUPPRESS, Action, ArgumentError, ArgumentParser, Namespace
from contextlib import redirect_stdout, suppress
from pathlib import Path

from roboneuron.hang_watch import HangWatch
from roboneuron.log_files import begin_logging
from roboneuron.plugins.availability import known_names
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.specs import FeatureSpec
from roboneuron.ros.installation import choose, find_sourced


def configure(parser: ArgumentParser) -> None:
    """Add the arguments of `roboneuron serve`."""
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="a roboneuron.toml; the embedded default without it",
    )
    parser.add_argument(
        "--transport",
        metavar="NAME",
        help="how clients connect: stdio, http ...; `server.transport` without it",
    )
    parser.add_argument("--host", help="address that http listens on; `http.host` without it")
    parser.add_argument(
        "--port", type=int, help="port of http, 0 for any free one; `http.port` without it"
    )
    parser.add_argument(
        "--log-level",
        choices=["debug", "info", "warning", "error"],
        default="info",
        help="of the log on stderr",
    )


def add_installed_flags(parser: ArgumentParser) -> None:
    """Add a flag for each feature of an installed plugin that can be switched on from the command
    line.

    A known feature that is not installed gets a hidden flag, whose error names the package to
    install.
    """
    with redirect_stdout(sys.stderr):  # stdout may be the wire of an agent, and plugins may print
        features = discover().specs(FeatureSpec).values()
    for spec in features:
        if spec.switch is None or not spec.keys:
            continue
        told = (
            f"{spec.switch} = true in [{spec.keys[0]}]: "
            f"{spec.summary[:1].lower()}{spec.summary[1:]}"
        )
        with suppress(ArgumentError):  # a feature named like one of the options above has no flag
            parser.add_argument(
                f"--{spec.name}", dest="switches", action="append_const", const=spec, help=told
            )
    for name in known_names("switch"):
        with suppress(ArgumentError):  # the flag exists already
            parser.add_argument(f"--{name}", action=_Absent, nargs=0, help=SUPPRESS)


class _Absent(Action):
    """The flag of a known feature that is unusable."""

    def __call__(self, *_: object) -> None:
        """Raise ConfigurationError with the reason and the package to install."""
        discover().get(FeatureSpec, self.dest)


def run(arguments: Namespace) -> int:
    """Run `roboneuron serve`.

    Imports are below, in the order of use, because a client waits for the first answer.

    Raises:
        ConfigurationError, PlanningError: as `load_config`, `choose` and `serve`.
    """
    wire = divert_standard_streams()
    begin_logging(arguments.log_level.upper())
    # objects of the start live until the end, and searching them for garbage takes 0.1 s; see
    # `shorten_pauses`
    gc.disable()
    watch = HangWatch()
    watch.start()
    with watch.loading():
        from roboneuron.config import load_config

        config = load_config(arguments.config, arguments=arguments)
        watch.bound(config.supervisor.hang_timeout_s)
        choose(config.ros.installation, find_sourced(os.environ, sys.prefix))
        from roboneuron.server.app import serve  # heavy

    serve(config, wire, watch)
    return 0


def divert_standard_streams() -> tuple[int, int]:
    """Move stdin and stdout to private descriptors, which children do not inherit (PEP 446); call
    it first.

    Afterwards nothing else is written to the wire: fd 1 is stderr and fd 0 the null device, also
    for child processes and C++ libraries, and before any import that might print.
    """
    wire = os.dup(0), os.dup(1)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    return wire

"""The command `roboneuron serve-policy`."""

from __future__ import annotations

import hashlib
import json
import logging
import signal
import sys
import tomllib
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

from roboneuron import ConfigurationError

if TYPE_CHECKING:
    from rn_backend_openpi.front import MakeModel
    from rn_backend_openpi.messages import Document
    from rn_backend_openpi.server_options import PolicyServerOptions

_COLUMNS = (
    ("model", "name"),
    ("state", "state"),
    ("pid", "pid"),
    ("robots", "clients"),
    ("batches", "batches"),
    ("ms median", "model_ms_median"),
    ("ms p99", "model_ms_p99"),
    ("refused", "refused"),
    ("lost", "lost"),
    ("restarts", "restarts"),
)


_FILES = {"unit": "serve-policy.service", "containerfile": "Containerfile"}


class ServePolicyCommand:
    """Serve the models of a file to robots on other machines, until Ctrl-C or SIGTERM.

    Each model has its own process, or replicas on a Ray cluster; they are restarted when they die.
    Robots use it with `address` under [plugins.shared].
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument(
            "action",
            nargs="?",
            choices=("run", "status", "unit", "containerfile"),
            default="run",
            help="serve (run), show a server that runs (status), or print a systemd unit or a "
            "container file that runs one",
        )
        parser.add_argument(
            "--config",
            type=Path,
            metavar="FILE",
            default=Path("policies.toml"),
            help="[listen] and [models.NAME]; policies.toml by default",
        )
        parser.add_argument(
            "--host", metavar="ADDRESS", help="address to listen on, instead of FILE's"
        )
        parser.add_argument("--port", type=int, metavar="N", help="likewise")
        parser.add_argument(
            "--engine",
            choices=("processes", "ray"),
            default="processes",
            help="each model in a process of this machine (processes), or in replicas on a Ray "
            "cluster (ray)",
        )
        parser.add_argument("--json", action="store_true", help="status as JSON")

    def run(self, arguments: Namespace) -> int:
        """Run the action; returns the exit status."""
        if arguments.action in _FILES:
            print(deployment_file(arguments.action, arguments.config), end="")
            return 0
        options = read_options(arguments)
        name = name_of(arguments.config)
        if arguments.action == "status":
            from rn_backend_openpi.links import private_directory
            from rn_backend_openpi.status_page import ask_status

            told = ask_status(private_directory(options.listen.directory) / f"{name}.sock")
            print(json.dumps(told, indent=2) if arguments.json else table_of(told))
            return 0
        if arguments.engine == "processes":
            return run_server(options, name)
        from rn_backend_openpi.ray_engine import ray_models

        with ray_models(options.ray) as make_model:
            return run_server(options, name, make_model=make_model)


def run_server(
    options: PolicyServerOptions,
    name: str,
    tell: Callable[[int], object] = lambda port: None,
    make_model: MakeModel | None = None,
) -> int:
    """Serve in this process until SIGTERM or SIGINT; returns the exit status.

    Args:
        options: those of the server.
        name: its name among others of this user.
        tell: called with the port once all models are ready.
        make_model: see `PolicyServer`; processes of this machine if None.
    """
    from rn_backend_openpi.front import PolicyServer
    from rn_backend_openpi.links import private_directory
    from rn_backend_openpi.processes import ModelProcess
    from roboneuron.command import HangWatch

    HangWatch().start()
    logging.basicConfig(format="%(asctime)s %(message)s")  # -v and -q have set up another log
    logging.getLogger("rn_backend_openpi").setLevel(logging.INFO)
    folder = private_directory(options.listen.directory)
    server = PolicyServer(options, folder, name, tell, make_model or ModelProcess)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: server.stop())
    return server.run()


def deployment_file(action: str, config: Path) -> str:
    """The systemd unit (`unit`) for this interpreter and a configuration file, or the container
    file.
    """
    text = (files(__package__) / "deployment" / _FILES[action]).read_text(encoding="utf-8")
    if action == "containerfile":
        return text
    # systemd splits at spaces and treats % as the start of a specifier
    words = {"python": sys.executable, "config": str(config.resolve())}
    return Template(text).substitute(
        {name: '"' + word.replace("%", "%%") + '"' for name, word in words.items()}
    )


def read_options(arguments: Namespace) -> PolicyServerOptions:
    """Options from the file and the command line.

    Raises:
        ConfigurationError: the file cannot be read, or is invalid.
    """
    path: Path = arguments.config
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"{path} cannot be read: {error}.",
            hint="It holds [listen] and a [models.NAME] for each model.",
        ) from error
    given = {key: getattr(arguments, key) for key in ("host", "port")}
    listen = tables.get("listen", {})
    if isinstance(listen, dict):
        chosen = {key: value for key, value in given.items() if value is not None}
        tables["listen"] = {**listen, **chosen}
    return options_of(tables, path.name)


def options_of(tables: dict[str, object], section: str) -> PolicyServerOptions:
    """The options in the tables of a server's file. Raises ConfigurationError, naming the section
    and the option.
    """
    from rn_backend_openpi.plugin import SERVE_COMMAND
    from rn_backend_openpi.server_options import PolicyServerOptions
    from roboneuron.feature import loading

    described = replace(
        SERVE_COMMAND, config="rn_backend_openpi.server_options:PolicyServerOptions"
    )
    options = loading.load_options(described, tables, section=section)
    assert isinstance(options, PolicyServerOptions)
    return options


def name_of(path: Path) -> str:
    """Name of the server of a file: the same for every process that names the file."""
    digest = hashlib.sha256(str(path.resolve()).encode()).hexdigest()
    return f"policies-{digest[:8]}"


def table_of(status: Document) -> str:
    """A status as a table for people."""
    rows = [[title for title, _ in _COLUMNS]]
    for name, model in status["models"].items():
        known = {"name": name, **model}
        rows.append([_cell(known.get(key)) for _, key in _COLUMNS])
    widths = [max(len(row[i]) for row in rows) for i in range(len(_COLUMNS))]
    lines = [
        f"{status['address']} (keys: {status['keys']}), {status['robots']} robots, "
        f"{status['refused_connections']} connections refused",
        *("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) for row in rows),
    ]
    lines += [
        f"{name}: {model['failure']}"
        for name, model in status["models"].items()
        if "failure" in model
    ]
    return "\n".join(line.rstrip() for line in lines)


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.1f}" if isinstance(value, float) else str(value)

"""The commands `roboneuron policy serve`, `share`, and `openpi` of earlier releases."""

from __future__ import annotations

import hashlib
import json
import logging
import signal
import sys
import tomllib
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

from roboneuron import BackendSpec, ConfigurationError

if TYPE_CHECKING:
    from rn_backend_openpi.front import MakeModel
    from rn_backend_openpi.messages import Document
    from rn_backend_openpi.server_options import PolicyServerOptions
    from roboneuron.feature import Config, Registry

_COLUMNS = {
    "model": "name",
    "state": "state",
    "pid": "pid",
    "robots": "clients",
    "batches": "batches",
    "ms median": "model_ms_median",
    "ms p99": "model_ms_p99",
    "refused": "refused",
    "lost": "lost",
    "restarts": "restarts",
}
_FILES = {"unit": "serve-policy.service", "containerfile": "Containerfile"}
_OF_THE_MODEL = ("waiting", "most", "linger_s", "stateless")
_NEW_NAMES = {"certificate_key": "key", "clients": "robots"}
log = logging.getLogger(__name__)


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
        options = _read_options(arguments)
        name = name_of(arguments.config)
        if arguments.action == "status":
            from rn_backend_openpi.links import private_directory
            from rn_backend_openpi.statistics import ask_status

            told = ask_status(private_directory(options.listen.directory) / f"{name}.sock")
            print(json.dumps(told, indent=2) if arguments.json else _table_of(told))
            return 0
        if arguments.engine == "processes":
            return _run_server(options, name)
        from rn_backend_openpi.ray_engine import ray_models

        with ray_models(options.ray) as make_model:
            return _run_server(options, name, make_model=make_model)


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
        from rn_backend_openpi.links import socket_of
        from rn_backend_openpi.options import PolicyOptions
        from rn_backend_openpi.plugin import SHARED
        from rn_backend_openpi.server_process import serve
        from roboneuron.command import load_config
        from roboneuron.feature import loading

        options = loading.load_options(SHARED, load_config(arguments.config).options(SHARED.name))
        assert isinstance(options, PolicyOptions)
        logging.getLogger("rn_backend_openpi").setLevel(logging.INFO)
        return serve(options.of_the_model(), socket_of(options), None)


class OpenpiServerCommand:
    """Serve the backend of [inference] over openpi's websocket until Ctrl-C or SIGTERM.

    Of earlier releases: `policy serve` with a model that has an `interface` does the same.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument(
            "--config",
            type=Path,
            metavar="FILE",
            help="a roboneuron.toml with [robot], [inference] and [plugins.openpi]",
        )
        parser.add_argument(
            "--host", help="address to listen on (default: as configured, else 127.0.0.1)"
        )
        parser.add_argument(
            "--port", type=int, help="port, 0 for any free one (default: as configured, else 8000)"
        )

    def run(self, arguments: Namespace) -> int:
        """Serve."""
        from rn_backend_openpi.listener import address_of
        from roboneuron.command import discover, load_config

        log.warning("policy openpi is old: policy serve serves a model with an `interface` alike.")
        registry = discover()
        served = served_options(load_config(arguments.config, registry), registry, arguments)
        scheme = "ws" if served.listen.certificate is None else "wss"
        (name,) = served.models

        def tell(port: int) -> None:
            url = f"{scheme}://{address_of(served.listen.host, port)}"
            print(f"Policy server: {url} (backend {name})", flush=True)

        return _run_server(served, name_of(arguments.config or Path("roboneuron.toml")), tell)


def _run_server(
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


def _read_options(arguments: Namespace) -> PolicyServerOptions:
    """Options from the file and the command line. Raises ConfigurationError."""
    path: Path = arguments.config
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"{path} cannot be read: {error}.",
            hint="It holds [listen] and a [models.NAME] for each model.",
        ) from error
    listen = tables.get("listen", {})
    if isinstance(listen, dict):
        tables["listen"] = {**listen, **_chosen(arguments)}
    return _options_of(tables, path.name)


def _chosen(arguments: Namespace) -> dict[str, object]:
    """What the command line says about the address."""
    given = {name: getattr(arguments, name) for name in ("host", "port")}
    return {name: value for name, value in given.items() if value is not None}


def _options_of(tables: Mapping[str, object], section: str) -> PolicyServerOptions:
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


def served_options(config: Config, registry: Registry, arguments: Namespace) -> PolicyServerOptions:
    """The options of a server of the backend that a robot's configuration names, with
    [plugins.openpi] as the interface and its table `server`.

    Args:
        config: its [robot], [inference] and options of plugins are read.
        registry: installed plugins.
        arguments: its host and port come first.

    Raises:
        ConfigurationError: no backend is named, or an option is wrong.
    """
    from rn_backend_openpi.interface_options import InterfaceOptions
    from rn_backend_openpi.plugin import BACKEND

    inference, tables = config.inference, config.options(BACKEND.name)
    if inference is None or inference.backend == BACKEND.name:
        raise ConfigurationError(
            "The configuration's [inference] names no backend that could be served: 'openpi' is "
            "itself a client of a server.",
            hint="Name the backend that holds the model in [inference].",
        )
    spec = registry.get(BackendSpec, inference.backend)
    own = tables.get("server", {})
    server = {**(own if isinstance(own, dict) else {}), **_chosen(arguments)}
    of_the_model = {name: server.pop(name) for name in _OF_THE_MODEL if name in server}
    of_interface = InterfaceOptions.model_fields.keys() & tables.keys()
    model = {
        "backend": spec.name,
        "checkpoint": inference.checkpoint,
        "options": dict(config.options(spec.name)),
        "runtime": inference.runtime,
        "runtime_options": dict(config.options(inference.runtime or spec.default_runtime or "")),
        "acceleration": inference.acceleration,
        "acceleration_options": dict(config.options(inference.acceleration or "")),
        "interface": {name: tables[name] for name in of_interface} | {"robot": config.robot.name},
        **of_the_model,
    }
    listen = {
        "port": 8000,
        "robots": 16,
        "keys": "none" if server.get("token_file") is None else "token",
        **{_NEW_NAMES.get(name, name): value for name, value in server.items()},
    }
    given = {"listen": listen, "models": {spec.name: model}}
    return _options_of(given, "plugins.openpi.server")


def name_of(path: Path) -> str:
    """Name of the server of a file: the same for every process that names the file."""
    digest = hashlib.sha256(str(path.resolve()).encode()).hexdigest()
    return f"policies-{digest[:8]}"


def _table_of(status: Document) -> str:
    """A status as a table for people."""
    models = {name: {"name": name, **model} for name, model in status["models"].items()}
    rows = [list(_COLUMNS)]
    rows += [[_cell(model.get(key)) for key in _COLUMNS.values()] for model in models.values()]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        f"{status['address']} (keys: {status['keys']}), {status['robots']} robots, "
        f"{status['refused_connections']} connections refused",
        *("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) for row in rows),
        *(f"{name}: {one['failure']}" for name, one in models.items() if "failure" in one),
    ]
    return "\n".join(line.rstrip() for line in lines)


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.1f}" if isinstance(value, float) else str(value)

"""The command `roboneuron openpi-server`: `serve-policy` for the backend of a robot's
configuration.
"""

from __future__ import annotations

import logging
from argparse import ArgumentParser, Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron import BackendSpec, ConfigurationError

if TYPE_CHECKING:
    from rn_backend_openpi.server_options import PolicyServerOptions
    from roboneuron.feature import Config, Registry

_OF_THE_MODEL = ("waiting", "most", "linger_s", "stateless")
_NEW_NAMES = {"certificate_key": "key", "clients": "robots"}
log = logging.getLogger(__name__)


class OpenpiServerCommand:
    """Serve the backend of [inference] over openpi's websocket until Ctrl-C or SIGTERM.

    Of earlier releases: `serve-policy` with a model that has an `interface` does the same.
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
        from rn_backend_openpi.plugin import BACKEND
        from rn_backend_openpi.serve_command import name_of, run_server
        from roboneuron.command import discover, load_config

        log.warning("openpi-server is old: serve-policy serves a model with an `interface` alike.")
        registry = discover()
        config = load_config(arguments.config, registry)
        tables = dict(config.options(BACKEND.name))
        chosen = {"host": arguments.host, "port": arguments.port}
        server = {name: value for name, value in chosen.items() if value is not None}
        served = served_options(config, registry, tables, server)
        scheme = "ws" if served.listen.certificate is None else "wss"
        (name,) = served.models

        def tell(port: int) -> None:
            print(
                f"Policy server: {scheme}://{served.listen.host}:{port} (backend {name})",
                flush=True,
            )

        return run_server(served, name_of(arguments.config or Path("roboneuron.toml")), tell)


def served_options(
    config: Config,
    registry: Registry,
    tables: Mapping[str, object],
    chosen: Mapping[str, object],
) -> PolicyServerOptions:
    """The options of a server of the backend that a configuration names.

    Args:
        config: its [robot], [inference] and options of plugins are read.
        registry: installed plugins.
        tables: [plugins.openpi]: the interface, and `server`.
        chosen: options of `server` that come first.

    Raises:
        ConfigurationError: no backend is named, or an option is wrong.
    """
    from rn_backend_openpi.interface_options import InterfaceOptions
    from rn_backend_openpi.plugin import BACKEND
    from rn_backend_openpi.serve_command import options_of

    inference = config.inference
    if inference is None:
        raise ConfigurationError(
            "The configuration has no [inference]: there is nothing to serve.",
            hint='Add [inference] with backend = "...".',
        )
    if inference.backend == BACKEND.name:
        raise ConfigurationError(
            "The backend 'openpi' is itself a client of a server; it cannot be served.",
            hint="Name the backend that holds the model in [inference].",
        )
    spec = registry.get(BackendSpec, inference.backend)
    own = tables.get("server", {})
    server = {**(own if isinstance(own, dict) else {}), **chosen}
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
    given: dict[str, object] = {"listen": listen, "models": {spec.name: model}}
    return options_of(given, "plugins.openpi.server")

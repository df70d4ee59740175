"""The command `roboneuron openpi-server`: `serve-policy` for the backend of a robot's
configuration.
"""

from __future__ import annotations

import logging
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron import BackendSpec, ConfigurationError, RuntimeSpec

if TYPE_CHECKING:
    from rn_backend_openpi.options import OpenpiOptions
    from rn_backend_openpi.shared_options import PolicyServerOptions
    from roboneuron.command import Config, Registry

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
        from rn_backend_openpi.options import OpenpiOptions
        from rn_backend_openpi.plugin import BACKEND
        from rn_backend_openpi.serve_command import name_of, run_server
        from roboneuron.command import discover, load_config, loading

        log.warning("openpi-server is old: serve-policy serves a model with an `interface` alike.")
        registry = discover()
        config = load_config(arguments.config, registry)
        tables = dict(config.options(BACKEND.name))
        chosen = {"host": arguments.host, "port": arguments.port}
        given = {name: value for name, value in chosen.items() if value is not None}
        if given:
            own = tables.get("server", {})
            tables["server"] = {**own, **given} if isinstance(own, dict) else own
        options = loading.load_options(BACKEND, tables)
        assert isinstance(options, OpenpiOptions)
        served, summary = served_options(config, registry, options)
        scheme = "ws" if served.listen.certificate is None else "wss"

        def tell(port: int) -> None:
            where = f"{scheme}://{served.listen.host}:{port}"
            print(f"Policy server: {where} ({summary})", flush=True)

        return run_server(served, name_of(arguments.config or Path("roboneuron.toml")), tell)


def served_options(
    config: Config, registry: Registry, options: OpenpiOptions
) -> tuple[PolicyServerOptions, str]:
    """The options of a server of the backend that a configuration names; and a summary of what it
    serves: backend, profile and control space.

    Args:
        config: its [robot], [inference] and options of plugins are read.
        registry: installed plugins.
        options: those of [plugins.openpi].

    Raises:
        ConfigurationError: no backend is named, or it does not match the profile; names both sides.
    """
    from rn_backend_openpi.interface import served_layout
    from rn_backend_openpi.plugin import BACKEND
    from rn_backend_openpi.shared_options import (
        ListenOptions,
        PolicyServerOptions,
        ServedModelOptions,
    )
    from rn_backend_openpi.shared_space import space_of
    from roboneuron.command import load_profile

    inference, server = config.inference, options.server
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
    runtime = inference.runtime or spec.default_runtime or None
    if runtime is not None:
        registry.get(RuntimeSpec, runtime)
    robot = config.robot.name
    model = ServedModelOptions(
        backend=spec.name,
        checkpoint=inference.checkpoint,
        options=dict(config.options(spec.name)),
        runtime=runtime,
        runtime_options=dict(config.options(runtime or "")),
        acceleration=inference.acceleration,
        acceleration_options=dict(config.options(inference.acceleration or "")),
        stateless=server.stateless,
        most=server.most,
        waiting=server.waiting,
        linger_s=server.linger_s,
        interface=options.interface().model_copy(update={"robot": robot}),
    )
    assert model.interface is not None
    space = space_of(spec, model, load_profile(registry, robot))
    layout = served_layout(model.interface, spec, space)
    summary = f"backend {spec.name}, profile {layout.name}, {layout.rows.space.kind}"
    listen = ListenOptions(
        host=server.host or "127.0.0.1",
        port=server.port,
        keys="none" if server.token_file is None else "token",
        token_file=server.token_file,
        certificate=server.certificate,
        key=server.certificate_key,
        insecure=server.insecure,
        robots=server.clients,
    )
    return PolicyServerOptions(listen=listen, models={spec.name: model}), summary

"""The command `roboneuron openpi-server`."""

from __future__ import annotations

import logging
from argparse import ArgumentParser, Namespace
from pathlib import Path


class OpenpiServerCommand:
    """Serve the backend of [inference] over openpi's websocket until Ctrl-C or SIGTERM."""

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
        import asyncio
        import signal

        from rn_backend_openpi.options import OpenpiOptions
        from rn_backend_openpi.plugin import BACKEND
        from rn_backend_openpi.server import LOOPBACK, OpenpiServer, check_listening, run_server
        from rn_backend_openpi.serving import make_policy
        from roboneuron.command import discover, load_config, loading

        registry = discover()
        config = load_config(arguments.config, registry)
        options = loading.load_options(BACKEND, config.options(BACKEND.name))
        assert isinstance(options, OpenpiOptions)
        host = arguments.host or options.server.host or LOOPBACK
        port = options.server.port if arguments.port is None else arguments.port
        logging.getLogger("rn_backend_openpi").setLevel(logging.INFO)
        key, tls = check_listening(host, options.server)
        policy = make_policy(config, registry, options)
        policy.load()

        def tell(opened: int) -> None:
            scheme = "ws" if tls is None else "wss"
            print(f"Policy server: {scheme}://{host}:{opened} ({policy.summary})", flush=True)

        async def serve() -> None:
            until = asyncio.Event()
            for number in (signal.SIGTERM, signal.SIGINT):
                asyncio.get_running_loop().add_signal_handler(number, until.set)
            server = OpenpiServer(policy, options.server, key)
            await run_server(server, (host, port), tls, tell, until)

        try:
            asyncio.run(serve())
        finally:
            policy.close()
        return 0

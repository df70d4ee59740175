"""Where a policy server listens: the address for robots, and the local socket of its status."""

from __future__ import annotations

import os
import socket
from contextlib import suppress
from pathlib import Path

from roboneuron import ConfigurationError

_BACKLOG = 1024


def network_listener(host: str, port: int) -> socket.socket:
    """A listening TCP socket; raises ConfigurationError when the address cannot be used."""
    try:
        return socket.create_server((host, port), backlog=_BACKLOG)
    except OSError as error:
        raise ConfigurationError(
            f"The policy server cannot listen on {host}:{port}: {error.strerror or error}.",
            hint="Does another one run there? Choose another host or port in [listen].",
        ) from error


def local_listener(path: Path) -> socket.socket:
    """A listening Unix socket; raises ConfigurationError when a server has it already."""
    listener = socket.socket(socket.AF_UNIX)
    try:
        with socket.socket(socket.AF_UNIX) as probe:
            if probe.connect_ex(str(path)) == 0:
                raise ConfigurationError(
                    "A policy server of this file runs already.",
                    hint="Look at it with `roboneuron serve-policy status`.",
                )
        path.unlink(missing_ok=True)
        listener.bind(str(path))
        listener.listen()
    except OSError as error:
        listener.close()
        raise ConfigurationError(f"The socket {path} cannot be made: {error}.") from error
    except ConfigurationError:
        listener.close()
        raise
    return listener


def notify_manager() -> None:
    """Tell systemd that the service has begun. Source: sd_notify(3)."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told, suppress(OSError):
        told.connect(f"\0{address[1:]}" if address.startswith("@") else address)
        told.send(b"READY=1")

"""Sockets of a policy server: the network address for robots, and the local socket for its
status.
"""

from __future__ import annotations

import os
import socket
from contextlib import suppress
from pathlib import Path

from roboneuron import ConfigurationError

_BACKLOG = 1024


def network_listener(host: str, port: int) -> socket.socket:
    """Create a listening TCP socket. Raises ConfigurationError if the address cannot be used."""
    try:
        return socket.create_server((host, port), backlog=_BACKLOG)
    except OSError as error:
        raise ConfigurationError(
            f"The policy server cannot listen on {host}:{port}: {error.strerror or error}.",
            hint="Is another one running? Choose another host or port in [listen].",
        ) from error


def local_listener(path: Path) -> socket.socket:
    """Create a listening Unix socket. Raises ConfigurationError if a server uses it already."""
    listener = socket.socket(socket.AF_UNIX)
    try:
        with socket.socket(socket.AF_UNIX) as probe:
            if probe.connect_ex(str(path)) == 0:
                raise ConfigurationError(
                    "A policy server of this file is already running.",
                    hint="See `roboneuron serve-policy status`.",
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
    """Notify systemd that the service is ready. Source: sd_notify(3)."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told, suppress(OSError):
        told.connect(f"\0{address[1:]}" if address.startswith("@") else address)
        told.send(b"READY=1")

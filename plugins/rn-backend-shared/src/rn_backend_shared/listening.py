"""Listening sockets of servers: the network address of a policy server, the local socket for its
status, and the connections that they accept.
"""

from __future__ import annotations

import errno
import logging
import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from roboneuron import ConfigurationError

log = logging.getLogger(__name__)
_BACKLOG = 1024
_CLOSED = (errno.EBADF, errno.EINVAL)
"""Errors of a listener that was closed."""
_NO_HANDLES = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
_NO_HANDLES_S = 1.0
_PAUSE_S = 0.1
"""Pause after any other error, so that a lasting one does not keep a core busy [s]."""


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


def connections(
    listener: socket.socket, ended: threading.Event, make_room: Callable[[], object]
) -> Iterator[tuple[socket.socket, str]]:
    """Accept connections until the server ends, or the listener is closed.

    Every other error concerns one connection, or passes: it is logged, once while it lasts, and the
    next connection is accepted. Source: accept(2), "Error handling".

    Args:
        listener: listening socket.
        ended: set when the server ends.
        make_room: closes a connection; called when there is no handle for a new one.

    Yields:
        The connection, and the address of the peer; empty for a local socket.
    """
    logged = ""
    while not ended.is_set():
        try:
            connected, address = listener.accept()
        except OSError as error:
            if error.errno in _CLOSED:
                return
            if str(error) != logged:
                logged = str(error)
                log.error("A robot cannot connect: %s.", error.strerror or error)
            outlast(error, ended, make_room)
            continue
        logged = ""
        yield connected, str(address[0]) if isinstance(address, tuple) else ""


def outlast(error: OSError, ended: threading.Event, make_room: Callable[[], object]) -> None:
    """Pause after an error of a new connection; see `connections`."""
    if error.errno not in _NO_HANDLES:
        ended.wait(_PAUSE_S)
        return
    make_room()
    # the queue stays full until something is closed
    ended.wait(_NO_HANDLES_S)


def notify_manager() -> None:
    """Notify systemd that the service is ready. Source: sd_notify(3)."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told, suppress(OSError):
        told.connect(f"\0{address[1:]}" if address.startswith("@") else address)
        told.send(b"READY=1")

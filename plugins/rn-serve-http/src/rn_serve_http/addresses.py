"""The address that a section names: this machine's, kept to this machine unless tokens guard it, and free."""

from __future__ import annotations

import ipaddress
import socket

from rn_serve_http.tokens import TokenTable
from roboneuron import ConfigurationError


def bind(section: str, host: str, port: int, tokens: TokenTable) -> socket.socket:
    """A TCP socket bound to the address, not listening yet.

    Args:
        section: of roboneuron.toml that holds `host` and `port`, for the messages.
        tokens: who may connect; without any, only this machine may.

    Raises:
        ConfigurationError: the address is not loopback and there are no tokens, or it cannot be bound.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except OSError as error:
        raise ConfigurationError(f"[{section}] host = {host!r} is no address of this machine: {error}.") from error
    family, kind, protocol, _, address = found[0]
    if not ipaddress.ip_address(str(address[0]).partition("%")[0]).is_loopback and not tokens:
        raise ConfigurationError(
            f"[{section}] host = {host!r} can be reached from other machines, and there is no token: anybody could "
            "move the robot.",
            hint="Add [[http.tokens]] with name, role and variable or file, or listen on 127.0.0.1.",
        )
    bound = socket.socket(family, kind, protocol)
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
    except OSError as error:
        bound.close()
        raise ConfigurationError(
            f"Port {port} of {host} cannot be used: {error.strerror}.",
            hint=f"Does another one run? Choose another port, in [{section}] or with --port.",
        ) from error
    return bound

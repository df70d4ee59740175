"""Check of a configured listening address: local, restricted to this machine unless tokens protect
it, and free.
"""

from __future__ import annotations

import ipaddress
import socket

from rn_standard.http.tokens import TokenTable
from roboneuron import ConfigurationError


def check_address(
    section: str, host: str, port: int, tokens: TokenTable
) -> tuple[int, int, int, tuple[object, ...]]:
    """Check that listening on the address is permitted, whether or not it is in use.

    Args:
        section: section of roboneuron.toml with `host` and `port`, for messages.
        tokens: the permitted clients; without tokens, only this machine's.

    Returns:
        Family, kind, protocol and address, as for `socket.socket` and its `bind`.

    Raises:
        ConfigurationError: it is not an address, or it is not loopback and there are no tokens.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except OSError as error:
        raise ConfigurationError(
            f"[{section}] host = {host!r} is no address of this machine: {error}."
        ) from error
    family, kind, protocol, _, address = found[0]
    if not ipaddress.ip_address(str(address[0]).partition("%")[0]).is_loopback and not tokens:
        raise ConfigurationError(
            f"[{section}] host = {host!r} can be reached from other machines, and there is no "
            "token: anybody could "
            "move the robot.",
            hint="Add [[http.tokens]] with name, role and variable or file, or listen on "
            "127.0.0.1.",
        )
    return family, kind, protocol, address


def bind(section: str, host: str, port: int, tokens: TokenTable) -> socket.socket:
    """Create a TCP socket bound to the address, not listening yet; arguments as for
    `check_address`.

    Raises:
        ConfigurationError: as `check_address`; or it cannot be bound.
    """
    family, kind, protocol, address = check_address(section, host, port, tokens)
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


def network_of(address: str) -> str:
    """Return the address; for IPv6 the /64 network, since one machine may have all of its
    addresses.
    """
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if found.version == 4 or found.is_loopback:
        return str(found)
    return str(ipaddress.ip_network((found, 64), strict=False))

"""Allowed Host and Origin headers of a server; both are parsed, not compared by prefix."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Sequence
from contextlib import suppress
from typing import TypeVar

from rn_standard.http.options import HttpOptions
from roboneuron import ConfigurationError

T = TypeVar("T")
_LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
_ANY_ADDRESS = ("0.0.0.0", "::", "")
_ANY_PORT = -1
_AUTHORITY = re.compile(
    r"(\[[0-9A-Fa-f:.]{2,45}\]|[A-Za-z0-9][A-Za-z0-9._-]{0,252})(?::([0-9]{1,5}|\*))?"
)
"""A name or an address, and a port. Source: RFC 3986, section 3.2, without user information."""
_PORTS = {"http": 80, "https": 443}


class HostRules:
    """Allowed hosts and origins of the configuration.

    Raises:
        ConfigurationError: the server listens on every address and no name of this machine is
            given, or an entry of allowed_hosts or allowed_origins is invalid.
    """

    def __init__(self, options: HttpOptions) -> None:
        if options.host in _ANY_ADDRESS and not options.allowed_hosts:
            raise ConfigurationError(
                f"host = {options.host!r} listens on every address, so [http] must name in "
                "allowed_hosts how clients "
                "call this machine.",
                hint='Such as allowed_hosts = ["robot.lan", "192.168.1.20"].',
            )
        names = [*_LOOPBACK_NAMES, *map(_bracketed, options.allowed_hosts)]
        if options.host not in _ANY_ADDRESS:
            names.append(_bracketed(options.host))
        self._hosts = {_configured(_authority(name), "allowed_hosts", name) for name in names}
        origins = [*(f"http://{name}:*" for name in _LOOPBACK_NAMES), *options.allowed_origins]
        self._origins = {_configured(_origin(text), "allowed_origins", text) for text in origins}

    def allows_host(self, headers: Sequence[str]) -> bool:
        """True if the request has exactly one Host header, and it names this server."""
        found = _authority(headers[0]) if len(headers) == 1 else None
        if found is None or found[1] == _ANY_PORT:
            return False
        return (
            found in self._hosts
            or (found[0], None) in self._hosts
            or (found[0], _ANY_PORT) in self._hosts
        )

    def allows_origin(self, text: str) -> bool:
        """True if pages of this origin may connect."""
        found = _origin(text)
        if found is None or found[2] == _ANY_PORT:
            return False
        return found in self._origins or (*found[:2], _ANY_PORT) in self._origins


def _bracketed(name: str) -> str:
    """Format an IPv6 address as in a Host header; return anything else unchanged."""
    return f"[{name}]" if name.count(":") > 1 and not name.startswith("[") else name


def _authority(text: str) -> tuple[str, int | None] | None:
    """Parse a normalised name, and the port; None for an invalid authority."""
    match = _AUTHORITY.fullmatch(text)
    if match is None:
        return None
    name, port = match.group(1).lower().rstrip("."), match.group(2)
    with suppress(ValueError):
        name = str(ipaddress.ip_address(name.strip("[]")))
    if port is None or port == "*":
        return name, _ANY_PORT if port else None
    return (name, int(port)) if int(port) <= 65535 else None


def _origin(text: str) -> tuple[str, str, int] | None:
    """Parse scheme, name and port, with the scheme's default port if none is given."""
    scheme, separator, rest = text.partition("://")
    found = _authority(rest) if separator and scheme.lower() in _PORTS else None
    if found is None:
        return None
    return scheme.lower(), found[0], _PORTS[scheme.lower()] if found[1] is None else found[1]


def _configured(found: T | None, key: str, text: str) -> T:
    if found is None:
        raise ConfigurationError(
            f"{text!r} in [http] {key} is none.", hint='Such as "robot.lan", "https://panel.lan".'
        )
    return found

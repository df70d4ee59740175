"""Who looks: the addresses and pages that may connect, and the tokens, all as for HTTP."""

from __future__ import annotations

import ipaddress
import socket
from dataclasses import dataclass
from typing import Any

from rn_serve_http.options import HttpOptions
from rn_serve_http.origins import HostRules
from rn_serve_http.tokens import TokenTable
from rn_view.options import ViewOptions
from roboneuron import ConfigurationError
from roboneuron.server.access import LOCAL_PROCESS, Holder

_ANY_ADDRESS = ("0.0.0.0", "::", "")


@dataclass(frozen=True, kw_only=True, slots=True)
class Admission:
    """Who may look, and as whom.

    Attributes:
        tokens: of `[[http.tokens]]`; without any, everybody on this machine is let in.
        rules: hosts and origins of pages.
    """

    tokens: TokenTable
    rules: HostRules

    def visitor(self, number: int) -> Holder | None:
        """Who a new page is: None until it gives a token."""
        if self.tokens:
            return None
        return Holder(who=f"{LOCAL_PROCESS.who} view {number}", role=LOCAL_PROCESS.role, client=f"view {number}")

    def allows(self, headers: Any) -> bool:
        """Whether a connection may be: its Host is this machine, and its page comes from there or an allowed place."""
        origin = headers.get("Origin")
        return self.rules.allows_host(headers.get_all("Host")) and (origin is None or self.rules.allows_origin(origin))


def host_rules(options: ViewOptions, http: HttpOptions) -> HostRules:
    """The rules of `[http]` for the page's own address, which is one more origin.

    Raises:
        ConfigurationError: as HostRules.
    """
    names = [options.host] if options.host not in _ANY_ADDRESS else []
    own = [f"http://{_bracketed(name)}:*" for name in (*http.allowed_hosts, *names)]
    allowed = (*http.allowed_origins, *own)
    return HostRules(http.model_copy(update={"host": options.host, "allowed_origins": allowed}))


def check_address(options: ViewOptions, tokens: TokenTable) -> None:
    """Check that the page may be served on its address and that its port is free.

    Raises:
        ConfigurationError: the address is not loopback and there are no tokens, or it cannot be bound.
    """
    try:
        found = socket.getaddrinfo(options.host, options.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except OSError as error:
        raise ConfigurationError(f"[view] host = {options.host!r} is no address of this machine: {error}.") from error
    family, kind, protocol, _, address = found[0]
    if not ipaddress.ip_address(str(address[0]).partition("%")[0]).is_loopback and not tokens:
        raise ConfigurationError(
            f"[view] host = {options.host!r} can be reached from other machines, and there is no token: anybody could "
            "move the robot.",
            hint="Add [[http.tokens]] with name, role and variable or file, or listen on 127.0.0.1.",
        )
    with socket.socket(family, kind, protocol) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(address)
        except OSError as error:
            raise ConfigurationError(
                f"Port {options.port} of {options.host} cannot be used: {error.strerror}.",
                hint="Does another view run? Choose another `port` in [view].",
            ) from error


def _bracketed(name: str) -> str:
    return f"[{name}]" if name.count(":") > 1 and not name.startswith("[") else name

"""Access to the view: addresses, origins and tokens, as for HTTP."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rn_standard.http import addresses
from rn_standard.http.options import HttpOptions
from rn_standard.http.origins import HostRules
from rn_standard.http.tokens import TokenTable
from rn_view.options import ViewOptions
from roboneuron.feature import Holder

if TYPE_CHECKING:
    from websockets.datastructures import Headers

_ANY_ADDRESS = ("0.0.0.0", "::", "")


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewAccess:
    """Who may open a page, and as which holder.

    Attributes:
        tokens: of `[[http.tokens]]`. Without any, everybody on this machine has access.
        rules: allowed hosts and origins.
    """

    tokens: TokenTable
    rules: HostRules

    def visitor(self, number: int) -> Holder | None:
        """Holder of a new page; None if it must give a token first."""
        if self.tokens:
            return None
        return Holder.local(f"view {number}")

    def allows(self, headers: Headers) -> bool:
        """Whether to accept a connection: its Host must be this machine, and its Origin this
        machine or an allowed origin.
        """
        origin = headers.get("Origin")
        return self.rules.allows_host(headers.get_all("Host")) and (
            origin is None or self.rules.allows_origin(origin)
        )


def host_rules(options: ViewOptions, http: HttpOptions) -> HostRules:
    """The rules of `[http]`, with the view's own address as an allowed origin.

    Raises:
        ConfigurationError: as HostRules.
    """
    names = [options.host] if options.host not in _ANY_ADDRESS else []
    own = [f"http://{_bracketed(name)}:*" for name in (*http.allowed_hosts, *names)]
    allowed = (*http.allowed_origins, *own)
    return HostRules(http.model_copy(update={"host": options.host, "allowed_origins": allowed}))


def check_address(options: ViewOptions, tokens: TokenTable) -> None:
    """Check that the view may listen on its address. The port may be in use, for instance by a
    running server.

    Raises:
        ConfigurationError: as `rn_standard.http.addresses.check_address`.
    """
    addresses.check_address("view", options.host, options.port, tokens)


def check_port(options: ViewOptions, tokens: TokenTable) -> None:
    """Check the address as `check_address` does, and that its port is free.

    Raises:
        ConfigurationError: as `rn_standard.http.addresses.bind`.
    """
    addresses.bind("view", options.host, options.port, tokens).close()


def _bracketed(name: str) -> str:
    return f"[{name}]" if name.count(":") > 1 and not name.startswith("[") else name

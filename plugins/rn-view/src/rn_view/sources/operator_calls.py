"""Protocol of the tool calls that a page's buttons make."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from contextlib import AbstractContextManager
from typing import Protocol

from rn_view.teleoperation.sample_socket import PageTeleoperator
from roboneuron.feature import Holder


class Operator(Protocol):
    """Calls tools for a page. Without an operator the only button of a page is the emergency
    stop.
    """

    def call(self, holder: Holder, tool: str, arguments: dict[str, object]) -> Future[str]:
        """Call a tool as `holder`. Returns at once; the future gives the error text, empty on
        success.
        """
        ...

    def fetch(self, holder: Holder, tool: str) -> Future[Mapping[str, object]]:
        """Call a tool that needs no arguments, as `holder`. Returns at once; the future gives its
        structured result, empty when the tool refuses.
        """
        ...

    def has(self, tool: str) -> bool:
        """Whether the server has this tool."""
        ...

    def present(self, holder: Holder) -> AbstractContextManager[None]:
        """Context in which a page of this holder counts as open."""
        ...

    def leave(self, holder: Holder) -> None:
        """Called when the page of this holder is closed."""
        ...

    def lend(self, name: str, source: PageTeleoperator | None) -> bool:
        """Offer a teleoperator under a name, or withdraw it with None. Returns whether this server
        supports teleoperation.
        """
        ...

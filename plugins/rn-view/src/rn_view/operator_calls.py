"""What the buttons of a page ask of the server."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from contextlib import AbstractContextManager
from typing import Protocol

from rn_view.lead_socket import PageTeleoperator
from roboneuron.feature import Holder


class Operator(Protocol):
    """Calls tools for a page; the page of a view without one has no buttons but the stop."""

    def call(self, holder: Holder, tool: str, arguments: dict[str, object]) -> Future[str]:
        """Call a tool as `holder`; the text of its failure, empty when it did what it says. Returns
        at once.
        """
        ...

    def fetch(self, holder: Holder, tool: str) -> Future[Mapping[str, object]]:
        """Ask a tool without arguments as `holder`; what it says, empty when it refuses. Returns at
        once.
        """
        ...

    def has(self, tool: str) -> bool:
        """Whether there is such a tool."""
        ...

    def present(self, holder: Holder) -> AbstractContextManager[None]:
        """A page of this holder is open within the block."""
        ...

    def leave(self, holder: Holder) -> None:
        """The page of this holder was closed."""
        ...

    def lend(self, name: str, source: PageTeleoperator | None) -> bool:
        """Offer a teleoperator under a name, or take it back with None; whether arms can be led
        here.
        """
        ...

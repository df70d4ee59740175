"""Calls of the server's tools for the buttons of a page."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import AbstractContextManager, nullcontext
from typing import TypeVar

import anyio
from anyio import to_thread

from rn_standard.http.operator_lease import OperatorLease
from rn_standard.teleoperation.feature import TELEOPERATION, Teleoperation
from rn_view.teleoperation.sample_socket import PageTeleoperator
from rn_view.teleoperation.stick_panel import RATE_HZ
from roboneuron import Host
from roboneuron.feature import Holder

T = TypeVar("T")


class ServerOperator:
    """Calls tools on the server's event loop, as for MCP clients.

    Args:
        host: the server.
        lease: renewed by open pages and released when they close, so that another client may
            operate the robot.
    """

    def __init__(self, host: Host, lease: OperatorLease | None = None) -> None:
        self._host = host
        self._lease = lease
        self.loop: asyncio.AbstractEventLoop | None = None

    def call(self, holder: Holder, tool: str, arguments: dict[str, object]) -> Future[str]:
        """See Operator."""
        if self.loop is None:
            failed: Future[str] = Future()
            failed.set_result("The server does not serve clients yet.")
            return failed
        return asyncio.run_coroutine_threadsafe(self._call(holder, tool, arguments), self.loop)

    def fetch(self, holder: Holder, tool: str) -> Future[Mapping[str, object]]:
        """See Operator."""
        if self.loop is None:
            nothing: Future[Mapping[str, object]] = Future()
            nothing.set_result({})
            return nothing
        return asyncio.run_coroutine_threadsafe(self._fetch(holder, tool), self.loop)

    def has(self, tool: str) -> bool:
        """See Operator."""
        return self._host.tools.get(tool) is not None

    def present(self, holder: Holder) -> AbstractContextManager[None]:
        """See Operator; an open page renews the lease like an open stream."""
        return nullcontext() if self._lease is None else self._lease.present(holder.who)

    def leave(self, holder: Holder) -> None:
        """See Operator; releases nothing for a holder with a token, who may have other clients."""
        if holder.client and self._lease is not None:
            self._lease.release(holder.who)

    def lend(self, name: str, source: PageTeleoperator | None) -> bool:
        """See Operator."""
        feature = self._host.features.loaded.get(TELEOPERATION)
        if not isinstance(feature, Teleoperation):
            return False
        if source is None:
            feature.take_back(name)
        else:
            feature.lend(name, source, RATE_HZ)
        return True

    async def _call(self, holder: Holder, tool: str, arguments: dict[str, object]) -> str:
        result = await self._host.tools.call(tool, arguments, _Context(holder))
        if not result.is_error:
            return ""
        said = " ".join(block.text for block in result.content if block.type == "text")
        return said or "failed"

    async def _fetch(self, holder: Holder, tool: str) -> Mapping[str, object]:
        result = await self._host.tools.call(tool, {}, _Context(holder))
        return result.structured_content or {}


class _Context:
    """CallContext of a button."""

    simulated = False

    def __init__(self, holder: Holder) -> None:
        self.who, self.role = holder.who, holder.role

    async def run(
        self,
        work: Callable[[Callable[[str], None]], T],
        *,
        on_cancel: Callable[[], object] = lambda: None,
        on_leave: Callable[[], object] | None = None,
    ) -> T:
        """See CallContext. `on_leave` is ignored, because no button starts a motion that ends with
        its page.
        """
        thread = anyio.CapacityLimiter(1)
        try:
            return await to_thread.run_sync(
                lambda: work(lambda _: None), abandon_on_cancel=True, limiter=thread
            )
        except anyio.get_cancelled_exc_class():
            on_cancel()
            raise

    async def ask(self, question: str, what: str = "") -> str | None:
        """See CallContext. A button cannot ask a person, so the page cannot release the emergency
        stop.
        """
        return None

"""The feature: the transport `http`, and admission of one operator on every transport."""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence

import anyio

from rn_standard.http.local_clients import has_left
from rn_standard.http.operator_lease import OperatorLease
from rn_standard.http.options import HttpOptions
from rn_standard.http.origins import HostRules
from rn_standard.http.tokens import TokenFiles, read_tokens
from roboneuron import CallContext, Feature, Host, Tool, Transport
from roboneuron.feature import CallPhase, Config, Interceptor, StillReason

_LAPSE_S = 2.0
"""Longest wait for the end of motion after a lapsed lease."""


class HttpFeature(Feature[HttpOptions]):
    """Serves HTTP if `[server] transport` selects it; on every transport, admits one operator at a
    time.
    """

    lease: OperatorLease | None = None
    listener: socket.socket | None = None

    @property
    def identifies_clients(self) -> bool:
        """True if there are tokens."""
        return bool(self.options.tokens)

    def check(self, config: Config) -> None:
        """Check tokens, hosts and origins, if they will be used."""
        if config.server.transport == "http":
            read_tokens(self.options.tokens, os.environ)
            HostRules(self.options)

    def tools(self, host: Host) -> Sequence[Tool]:
        """Return take_over and heartbeat."""
        variables = [token.variable for token in self.options.tokens if token.variable is not None]
        host.modules.secret_variables.update(variables)

        def end_motion(reason: str) -> None:
            was_moving = host.is_moving
            host.end_motion(reason, _LAPSE_S)
            if was_moving:  # a client that only watched a robot at rest, and left, is no incident
                host.events.fault.tell("inference", "lease", {"explanation": reason})

        self.lease = OperatorLease(
            self.options.lease_on(host.config.server.transport),
            host.audit,
            end_motion,
            has_left=has_left,
            by_streams=self.options.lease_streams,
        )
        host.events.client.listen(self.lease.note_client)
        host.events.presence.listen(self.lease.note_presence)
        return self.lease.tools()

    def interceptors(self, host: Host) -> Sequence[Interceptor]:
        """Every call is checked by the lease."""
        assert self.lease is not None
        return [Interceptor(name="operator", phase=CallPhase.ARBITRATION, check=self.lease.admit)]

    def still_reasons(self, asker: CallContext | None) -> Sequence[StillReason]:
        """See `Feature.still_reasons`."""
        return () if self.lease is None else self.lease.still_reasons(asker)

    def start(self, host: Host) -> None:
        """Start watching the lease."""
        if self.lease is not None:
            self.lease.start()

    def listen(self, host: Host) -> Transport:
        """Read the tokens and bind the address; return the function that serves clients."""
        from rn_standard.http.server import listen, make_server  # heavy

        rules, tokens = HostRules(self.options), TokenFiles(self.options.tokens, os.environ)
        listener = self.listener = listen(self.options, tokens)
        server = make_server(host.server, self.options, rules, tokens, host.events)

        async def serve(leave: anyio.Event) -> None:
            async def end() -> None:
                await leave.wait()
                server.should_exit = True

            async with anyio.create_task_group() as group:
                group.start_soon(end)
                await server.serve(sockets=[listener])
                group.cancel_scope.cancel()

        return serve

    def close(self) -> None:
        """Stop watching the lease, and release the address."""
        if self.lease is not None:
            self.lease.close()
        if self.listener is not None:
            self.listener.close()

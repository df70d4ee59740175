"""The feature: the transport `stdio`."""

from __future__ import annotations

import logging
import os
import sys
from functools import partial

import anyio

from roboneuron import __version__
from roboneuron.server.feature import Feature
from roboneuron.server.host import Host
from roboneuron.server.tool import Transport

log = logging.getLogger(__name__)
_AT_A_TERMINAL = (
    "roboneuron serve waits for an MCP client on standard input, which is this terminal: an "
    "agent's client starts it "
    "(docs: Connect an agent). By hand use `roboneuron run`, or serve with --transport http. "
    "Ctrl-C ends it."
)


class StdioFeature(Feature[None]):
    """Serves stdio if `[server] transport` selects it."""

    def listen(self, host: Host) -> Transport:
        """Print a hint for a user at a terminal; return the function that serves the client."""
        if os.isatty(host.wire[0]):
            print(_AT_A_TERMINAL, file=sys.stderr)
        return partial(_serve, host)


async def _serve(host: Host, leave: anyio.Event) -> None:
    """Serve one client until it disconnects, or `leave` is set."""
    from roboneuron.stdio.message_stream import LineWriter, MessageStream  # heavy

    most = 2 * host.config.server.max_concurrent_calls + 64
    writer = LineWriter(host.wire[1])
    stream = MessageStream(host.wire[0], writer.write, most, host.end_soon)
    writer.start()

    async def end(scope: anyio.CancelScope) -> None:
        await leave.wait()
        scope.cancel()

    async with anyio.create_task_group() as group:
        group.start_soon(end, group.cancel_scope)
        stream.start()
        log.info("RoboNeuron %s serves MCP on stdio, pid %d.", __version__, os.getpid())
        await host.server.run(stream, stream, host.server.create_initialization_options())
        group.cancel_scope.cancel()
    writer.close()

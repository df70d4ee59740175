"""Serving an application: over stdio, or over the transport that a feature brings."""

from __future__ import annotations

import logging
import os
import signal
from functools import partial

import anyio

from roboneuron import __version__
from roboneuron.config import Config
from roboneuron.server.app import Application
from roboneuron.server.feature import Transport
from roboneuron.server.sections import check_configuration
from roboneuron.server.stdio import LineWriter, MessageReader, MessageWriter

log = logging.getLogger(__name__)
_END_S = 20.0
"""Ten times what an end takes; a machine that is overloaded needs up to 12 s."""


def _end_soon() -> None:
    """The kernel ends this process in a while, whatever hangs in it; its modules hear of that and leave.

    The default action of SIGALRM needs nobody's help. Callable from any thread.
    """
    signal.setitimer(signal.ITIMER_REAL, _END_S)


def serve(config: Config, wire: tuple[int, int]) -> None:
    """Serve clients until they leave for good, or SIGTERM or SIGINT comes; then stop everything.

    Args:
        config: says over which transport.
        wire: descriptors to read from and write to, for stdio.

    Raises:
        ConfigurationError, PlanningError: the configuration names what is not installed or does not fit, or the
            transport cannot be served (an address in use, a token that is missing).
    """
    application = Application(config)
    try:
        check_configuration(config, application.plugins.current())
        application.features.check()
        transport = application.features.listen(application.host) or partial(_serve_stdio, application, wire)
        application.loop.emergency_stop.press_on_signal(config.namespace)
        application.open()
        anyio.run(_serve, application, transport)
    finally:
        _end_soon()
        application.close()


async def _serve(application: Application, transport: Transport) -> None:
    leave = anyio.Event()

    async def leave_on_signal() -> None:
        with anyio.open_signal_receiver(signal.SIGTERM, signal.SIGINT) as signals:
            async for number in signals:
                log.info("Received %s: stopping everything.", signal.Signals(number).name)
                leave.set()
                return

    async with anyio.create_task_group() as group:
        group.start_soon(leave_on_signal)
        group.start_soon(application.settle)
        await transport(leave)
        group.cancel_scope.cancel()


async def _serve_stdio(application: Application, wire: tuple[int, int], leave: anyio.Event) -> None:
    """Serve one client until it leaves."""
    writer = LineWriter(wire[1])
    reader = MessageReader(
        wire[0], writer.write, 2 * application.loop.config.server.max_concurrent_calls + 64, _end_soon
    )
    writer.start()

    async def end(scope: anyio.CancelScope) -> None:
        await leave.wait()
        scope.cancel()

    async with anyio.create_task_group() as group:
        group.start_soon(end, group.cancel_scope)
        server = application.server
        reader.start()
        log.info("RoboNeuron %s serves MCP on stdio, pid %d.", __version__, os.getpid())
        await server.run(reader, MessageWriter(writer, reader), server.create_initialization_options())
        group.cancel_scope.cancel()
    writer.close()

"""Serving an application: over stdio, or over the transport that a feature brings."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import cast

import anyio

from roboneuron import __version__
from roboneuron.config import Config, fleet_feature
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.loading import load_attribute
from roboneuron.ros.environment import state_directory
from roboneuron.server.app import Application
from roboneuron.server.feature import Transport
from roboneuron.server.stdio import LineWriter, MessageReader, MessageWriter
from roboneuron.server.surface import AnnouncingServer, Served

log = logging.getLogger(__name__)
_END_S = 20.0
"""Ten times what an end takes; a machine that is overloaded needs up to 12 s."""


def _end_soon() -> None:
    """The kernel ends this process in a while, whatever hangs in it; its modules hear of that and
    leave.

    The default action of SIGALRM needs nobody's help. Callable from any thread.
    """
    signal.setitimer(signal.ITIMER_REAL, _END_S)


def make_served(config: Config) -> Served:
    """What serves a configuration: of one robot an Application, of several what a feature brings.

    Raises:
        ConfigurationError: no feature serves several robots.
    """
    if not config.robots:
        return Application(config)
    spec = fleet_feature(discover(config.disabled_plugins))
    make = cast(
        "Callable[[Config, Path], Served]",
        load_attribute(spec.fleet or "", f"feature {spec.name!r}"),
    )
    return make(config, state_directory(config.supervisor.state_directory))


def serve(config: Config, wire: tuple[int, int]) -> None:
    """Serve clients until they leave for good, or SIGTERM or SIGINT comes; then stop everything.

    Args:
        config: says over which transport.
        wire: descriptors to read from and write to, for stdio.

    Raises:
        ConfigurationError, PlanningError: the configuration names what is not installed or does not
            fit, or the transport cannot be served (an address in use, a token that is missing).
    """
    served = make_served(config)
    try:
        served.check()
        transport = served.listen() or partial(
            _serve_stdio, served.server, config.server.max_concurrent_calls, wire
        )
        served.press_on_signal()
        served.open()
        anyio.run(_serve, served, transport)
    finally:
        _end_soon()
        served.close()


async def _serve(served: Served, transport: Transport) -> None:
    leave = anyio.Event()

    async def leave_on_signal() -> None:
        with anyio.open_signal_receiver(signal.SIGTERM, signal.SIGINT) as signals:
            async for number in signals:
                log.info("Received %s: stopping everything.", signal.Signals(number).name)
                leave.set()
                return

    async with anyio.create_task_group() as group:
        group.start_soon(leave_on_signal)
        group.start_soon(served.settle)
        await transport(leave)
        group.cancel_scope.cancel()


async def _serve_stdio(
    server: AnnouncingServer, most_calls: int, wire: tuple[int, int], leave: anyio.Event
) -> None:
    """Serve one client until it leaves."""
    writer = LineWriter(wire[1])
    reader = MessageReader(wire[0], writer.write, 2 * most_calls + 64, _end_soon)
    writer.start()

    async def end(scope: anyio.CancelScope) -> None:
        await leave.wait()
        scope.cancel()

    async with anyio.create_task_group() as group:
        group.start_soon(end, group.cancel_scope)
        reader.start()
        log.info("RoboNeuron %s serves MCP on stdio, pid %d.", __version__, os.getpid())
        await server.run(
            reader, MessageWriter(writer, reader), server.create_initialization_options()
        )
        group.cancel_scope.cancel()
    writer.close()

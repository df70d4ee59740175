"""The process that relays ROS messages between this machine and its paired machines.

To Fast DDS the link is UDP on the loopback interface. One relay serves all processes of a machine;
it follows changes by `roboneuron link`, so that a removed machine is disconnected at once. Standard
library only: it starts in a tenth of a second.
"""

from __future__ import annotations

import asyncio
import logging
import ssl
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path

from rn_link.machine import Machine, link_folder, read_machine
from rn_link.ports import ParticipantPort, Ports
from rn_link.state import PeerConnection, StateFile, connected_now, hint_for
from rn_link.stream import LinkStream
from rn_link.tls import tls_context
from roboneuron import ConfigurationError

log = logging.getLogger("rn_link")
LOOK_S = 0.5
"""Period of checks for changes of the link."""
PAUSE_S = 0.5
"""Pause between two attempts to connect."""
_ATTEMPT_S = 3.0


class Relay:
    """All connections of one machine's link, from `run` until it ends."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._ports = Ports(self._forward, folder / "ports.json")
        self._streams: dict[str, LinkStream] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._known: dict[str, tuple[object, ...]] = {}
        self._state = StateFile(folder)

    async def run(self, ended: asyncio.Event) -> None:
        """Relay messages until `ended` is set, or this machine has no link any more."""
        try:
            while not ended.is_set():
                machine = read_machine(self._folder)
                if machine is None:
                    return
                await self._follow(machine)
                self._ports.forget()
                with suppress(TimeoutError):
                    await asyncio.wait_for(ended.wait(), LOOK_S)
        finally:
            for name in list(self._known):
                await self._leave(name)
            self._ports.close()

    async def _follow(self, machine: Machine) -> None:
        """Disconnect removed machines, and reconnect those whose certificates have changed."""
        found = {name: _stamps(self._folder, machine, name) for name in machine.peers}
        for name, stamps in list(self._known.items()):
            if found.get(name) != stamps:
                await self._leave(name)
        for name in found.keys() - self._known.keys():
            self._known[name] = found[name]
            self._tasks[name] = asyncio.create_task(self._keep(name, machine))

    async def _leave(self, name: str) -> None:
        """End the connection of a machine."""
        del self._known[name]
        self._state.forget(name)
        task = self._tasks.pop(name)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        if name in self._streams:
            self._streams.pop(name).close()

    def _forward(self, machine: str | None, place: ParticipantPort, message: bytes) -> None:
        for name, stream in self._streams.items():
            if machine in (None, name):
                stream.send(place, message)

    async def _keep(self, name: str, machine: Machine) -> None:
        """Keep a machine connected, with endless retries; no error of one concerns another."""
        meet = self._connect if machine.role == "hub" else self._listen
        while True:
            try:
                context = tls_context(machine, self._folder, name)
            except OSError as error:  # includes TLS errors
                files = f"own.pem, own.key and peers/{name}.pem in {self._folder}"
                hint = f"Check {files}, or pair {name} again with `roboneuron link`."
                failed = PeerConnection(error=f"its keys cannot be used: {error}", hint=hint)
                self._state.set(name, failed)
            else:
                try:
                    await meet(name, machine, context)
                except OSError as error:  # includes TLS errors and timeouts
                    told = str(error) or "no answer"
                    hint = hint_for(machine, name, error)
                    self._state.set(name, PeerConnection(error=told, hint=hint))
            await asyncio.sleep(PAUSE_S)

    async def _connect(self, name: str, machine: Machine, context: ssl.SSLContext) -> None:
        """Connect to a member until the connection ends."""
        async with asyncio.timeout(_ATTEMPT_S):
            connection = await asyncio.open_connection(*machine.peers[name], ssl=context)
        await self._carry(name, machine, *connection)

    async def _listen(self, name: str, machine: Machine, context: ssl.SSLContext) -> None:
        """Listen for the hub until cancelled."""
        task = asyncio.current_task()

        async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            if self._tasks.get(name) is not task:  # removed during the handshake
                writer.transport.abort()
                return
            # the hub reconnects after losing a connection that still looks alive on this side
            if name in self._streams:
                self._streams[name].close()
            await self._carry(name, machine, reader, writer)

        server = await asyncio.start_server(
            accept, "0.0.0.0", machine.port, ssl=context, ssl_handshake_timeout=_ATTEMPT_S
        )
        hint = (
            f"Start RoboNeuron on {name}, or `roboneuron link run`; it has to reach TCP "
            f"{machine.port} here."
        )
        self._state.set(name, PeerConnection(error="it has not connected yet", hint=hint))
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            server.close()

    async def _carry(
        self,
        name: str,
        machine: Machine,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        stream: LinkStream | None = None
        try:
            stream = LinkStream(reader, writer, partial(self._ports.deliver, name))
            self._streams[name] = stream
            self._state.set(name, connected_now())
            await stream.run()
        except (OSError, EOFError) as error:
            if self._streams.get(name) is stream:
                told = "the other side has ended it" if isinstance(error, EOFError) else str(error)
                hint = hint_for(machine, name, error)
                self._state.set(name, PeerConnection(error=f"lost: {told}", hint=hint))
        finally:
            writer.transport.abort()
            if stream is not None and self._streams.get(name) is stream:
                del self._streams[name]


def _stamps(folder: Path, machine: Machine, name: str) -> tuple[object, ...]:
    """A value that changes with the files and settings of a peer."""
    files = ("own.pem", "own.key", f"peers/{name}.pem")
    stamps = tuple(_stamp(folder / file) for file in files)
    return (machine.role, machine.port, machine.peers[name], stamps)


def _stamp(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:  # it is being replaced, or `tls_context` tells why it cannot be read
        return 0


async def serve(folder: Path) -> None:
    """Relay until standard input ends, or this machine has no link any more."""
    ended = asyncio.Event()
    # the other end is in the parent process, and closes with it
    asyncio.get_running_loop().add_reader(sys.stdin.fileno(), ended.set)
    while not ended.is_set():
        try:
            await Relay(folder).run(ended)
            return
        except (OSError, ConfigurationError) as error:
            log.warning("The link does not work: %s", error)
            with suppress(TimeoutError):
                await asyncio.wait_for(ended.wait(), 1.0)


if __name__ == "__main__":
    logging.basicConfig(format="%(levelname)s %(name)s: %(message)s")
    # asyncio warns of data written after the other side has closed
    logging.getLogger("asyncio").setLevel(logging.ERROR)
    asyncio.run(serve(link_folder()))

"""The process that relays ROS messages between this machine and its paired machines.

To Fast DDS the link is UDP on the loopback interface. One relay serves all processes of a machine;
it follows changes by `roboneuron link`, so that a removed machine is disconnected at once. Standard
library only: it starts in a tenth of a second.
"""

from __future__ import annotations

import asyncio
import fcntl
import json
import logging
import sys
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from rn_link.machine import IDENTITY, Machine, link_folder, read_machine
from rn_link.peer_link import PeerLink
from rn_link.ports import ParticipantPort, Ports
from rn_link.state import LOCK, STATE, PeerConnection
from roboneuron import ConfigurationError, foreign

log = logging.getLogger("rn_link")
LOOK_S = 0.5
"""Period of checks for changes of the link."""


class Relay:
    """All connections of one machine's link, from `run` until it ends."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._ports = Ports(self._forward)
        # by machine: what its link was made from, the link, and its task
        self._links: dict[str, tuple[object, PeerLink, asyncio.Task[None]]] = {}
        self._states: dict[str, PeerConnection] = {}

    async def run(self, ended: asyncio.Event) -> None:
        """Relay messages until `ended` is set, or this machine has no link any more."""
        try:
            while not ended.is_set() and (machine := read_machine(self._folder)) is not None:
                await self._follow(machine)
                self._ports.forget()
                with suppress(TimeoutError):
                    await asyncio.wait_for(ended.wait(), LOOK_S)
        finally:
            for name in list(self._links):
                await self._leave(name)
            self._ports.close()

    async def _follow(self, machine: Machine) -> None:
        """Disconnect removed machines, and reconnect those whose certificates have changed."""
        own = [path.stat().st_mtime_ns for path in self._folder.glob(IDENTITY)]
        found = {name: (own, peer) for name, peer in machine.peers.items()}
        for name, (made_from, *_) in list(self._links.items()):
            if found.get(name) != made_from:
                await self._leave(name)
        for name in found.keys() - self._links.keys():
            link = PeerLink(machine, self._folder, name, self._ports.deliver, self._tell)
            self._links[name] = found[name], link, asyncio.create_task(link.run())

    async def _leave(self, name: str) -> None:
        """End the connection of a machine."""
        *_, task = self._links.pop(name)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        self._states.pop(name, None)

    def _tell(self, name: str, state: PeerConnection) -> None:
        """Log and publish the state of a connection."""
        if self._states.get(name) == state:
            return
        self._states[name] = state
        log.warning("%s: %s.", name, "linked" if state.is_open else f"no link: {state.error}")
        try:
            facts = {name: asdict(one) for name, one in self._states.items()}
            foreign.write_private(self._folder / STATE, json.dumps(facts))
        except OSError as error:
            log.warning("%s cannot be saved: %s", STATE, error)

    def _forward(self, machine: str | None, place: ParticipantPort, message: bytes) -> None:
        for name, (_, link, _) in self._links.items():
            if machine in (None, name):
                link.send(place, message)


async def serve(folder: Path) -> None:
    """Relay until standard input ends, whenever no other process of this machine does."""
    ended = asyncio.Event()
    # the other end is in the parent process, and closes with it
    asyncio.get_running_loop().add_reader(sys.stdin.fileno(), ended.set)
    while not ended.is_set():
        try:
            with (folder / LOCK).open("wb") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                (folder / STATE).unlink(missing_ok=True)  # of an earlier relay
                await Relay(folder).run(ended)
        except (BlockingIOError, FileNotFoundError):
            pass
        except (OSError, ConfigurationError) as error:
            log.warning("The link does not work: %s", error)
        with suppress(TimeoutError):
            await asyncio.wait_for(ended.wait(), LOOK_S)


if __name__ == "__main__":
    logging.basicConfig(format="%(levelname)s %(name)s: %(message)s")
    # asyncio warns of data written after the other side has closed
    logging.getLogger("asyncio").setLevel(logging.ERROR)
    asyncio.run(serve(link_folder()))

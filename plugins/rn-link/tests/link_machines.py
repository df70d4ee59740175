"""Machines for tests: network namespaces on one switch, each with its own shared memory and files;
needs root.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

from rn_testing.waiting import wait_until

TALKER, WATCHER = (Path(__file__).with_name(f"link_{name}.py") for name in ("talker", "watcher"))
NETWORK = "10.213.91"


def impossible() -> str:
    """Reason why machines are impossible; empty if they are possible."""
    if os.geteuid() != 0:
        return "needs the rights to make network namespaces"
    made = subprocess.run(
        ["unshare", "-n", "-m", "ip", "link", "add", "switch", "type", "bridge"],
        capture_output=True,
        check=False,
    )
    return (
        ""
        if made.returncode == 0
        else "this machine makes no network namespaces, or the guard forbids it (--unguarded)"
    )


class Talker:
    """A process that publishes its name on `/talk`, and counts the received names."""

    def __init__(self, name: str, process: subprocess.Popen[bytes], folder: Path) -> None:
        self.name = name
        self.process = process
        self._report = folder / f"{name}.json"
        self.log = folder / f"{name}.log"

    def report(self) -> dict[str, Any]:
        """Its last report; empty before the first."""
        try:
            found: dict[str, Any] = json.loads(self._report.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        return found

    def heard(self, name: str) -> int:
        """Number of messages received from `name`."""
        return int(self.report().get("heard", {}).get(name, 0))

    def longest_gap_s(self, name: str) -> float:
        """Longest time between two messages of `name` [s]."""
        return float(self.report().get("gaps_s", {}).get(name, 0.0))

    def wait_for(self, name: str, more: int = 5, timeout_s: float = 20.0) -> float:
        """Wait for further messages of `name`; returns the time that it took [s]."""
        goal = self.heard(name) + more
        return wait_until(
            lambda: self.heard(name) >= goal,
            timeout_s,
            f"{self.name} hears {name}: {self.log.read_text()[-2000:]}, {self._report}",
        )

    def end(self) -> None:
        """Kill it and reap it."""
        self.process.kill()
        self.process.wait(10.0)


class Machine:
    """A network namespace with its own loopback, /dev/shm and state directory.

    Args:
        folder: folder for its files.
        number: last byte of its address.
    """

    def __init__(self, folder: Path, name: str, number: int) -> None:
        self.name = name
        self.address = f"{NETWORK}.{number}"
        self.state = folder / name
        self.state.mkdir(parents=True)
        self._holder = subprocess.Popen(
            ["unshare", "-n", "-m", "sh", "-c", "mount -t tmpfs tmpfs /dev/shm; exec sleep 900"]
        )
        self._talkers: list[Talker] = []
        wait_until(self._is_apart, 5.0, "a namespace of its own")

    def _is_apart(self) -> bool:
        mounts = Path(f"/proc/{self._holder.pid}/comm").read_text(encoding="ascii")
        return mounts.strip() == "sleep"

    @property
    def pid(self) -> int:
        """The process that holds its namespaces."""
        return self._holder.pid

    @property
    def link(self) -> Path:
        """Folder of its link."""
        return self.state / "roboneuron" / "link"

    def inside(self, *command: str) -> list[str]:
        """The command line that runs a command on this machine."""
        return ["nsenter", "-t", str(self.pid), "-n", "-m", *command]

    def run(self, *command: str) -> None:
        """Run a command on this machine."""
        subprocess.run(self.inside(*command), check=True, capture_output=True)

    def talk(
        self,
        name: str,
        *arguments: str,
        link: bool = True,
        script: Path = TALKER,
        **variables: str,
    ) -> Talker:
        """Start a talker on this machine.

        Args:
            link: True to use the machine's link; otherwise only `variables`.
            script: script to run.
        """
        environment = {
            **{k: v for k, v in os.environ.items() if not k.startswith(("ROS_AUTO", "FAST"))},
            "XDG_STATE_HOME": str(self.state if link else self.state / "none"),
            **variables,
        }
        with (self.state / f"{name}.log").open("wb") as log:
            process = subprocess.Popen(
                self.inside(sys.executable, str(script), name, str(self.state), *arguments),
                env=environment,
                stdout=log,
                stderr=log,
            )
        talker = Talker(name, process, self.state)
        self._talkers.append(talker)
        return talker

    def cut(self) -> None:
        """Disconnect its cable."""
        self.run("ip", "link", "set", "cable", "down")

    def plug(self) -> None:
        """Connect its cable again."""
        self.run("ip", "link", "set", "cable", "up")

    def lose(self, other: Machine) -> None:
        """Lose silently everything that it sends to another machine."""
        self._address_frames(other, "02:00:00:00:00:99")

    def find(self, other: Machine) -> None:
        """Stop losing messages to the other machine."""
        found = subprocess.run(
            other.inside("ip", "-json", "link", "show", "cable"),
            check=True,
            capture_output=True,
            text=True,
        )
        self._address_frames(other, str(json.loads(found.stdout)[0]["address"]))

    def _address_frames(self, other: Machine, hardware: str) -> None:
        entry = [other.address, "lladdr", hardware, "dev", "cable", "nud", "permanent"]
        self.run("ip", "neigh", "replace", *entry)

    def close(self) -> None:
        """End its processes, and with them the namespaces."""
        for talker in self._talkers:
            talker.end()
        self._holder.kill()
        self._holder.wait(10.0)


@contextmanager
def machines(folder: Path, *names: str) -> Iterator[Mapping[str, Machine]]:
    """Machines on one switch, until the context ends."""
    with ExitStack() as stack:
        switch = stack.enter_context(closing(Machine(folder, "switch", 254)))
        switch.run("ip", "link", "add", "switch", "type", "bridge")
        switch.run("ip", "link", "set", "switch", "up")
        made = {}
        for number, name in enumerate(names, 1):
            made[name] = stack.enter_context(closing(Machine(folder, name, number)))
            _connect(made[name], switch, f"port{number}")
        yield made


def _connect(machine: Machine, switch: Machine, port: str) -> None:
    veth = ["type", "veth", "peer", "name", port, "netns", str(switch.pid)]
    machine.run("ip", "link", "add", "cable", *veth)
    machine.run("ip", "addr", "add", f"{machine.address}/24", "dev", "cable")
    for device in ("lo", "cable"):
        machine.run("ip", "link", "set", device, "up")
    machine.run("ip", "route", "add", "224.0.0.0/4", "dev", "cable")
    switch.run("ip", "link", "set", port, "master", "switch")
    switch.run("ip", "link", "set", port, "up")

"""Faults of the link to the server of a policy: their kinds, and the machine where they happen."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from policy_servers import RunningServer, link_of

RATE_HZ, ROWS, STEP_S = 30.0, 8, 0.05
DIRECT = (
    "cable cut",
    "packets lost both ways",
    "packets lost one way",
    "server frozen",
    "model frozen",
    "server killed",
    "model killed",
    "keys swapped there",
    "keys swapped here",
)
SPOILT = (
    "replayed answer",
    "replayed before the answer",
    "answered twice",
    "garbage",
    "half an answer",
    "slow drip",
    "answers held back",
    "huge length",
    "swallowed",
    "handshake without a word",
    "garbage before the handshake",
    "answers' records twice",
    "requests' records twice",
    "an old record again",
)
HARMLESS = ("answered twice",)
"""The right answer arrives too; the spoilt data must only not be executed."""


class Trial(NamedTuple):
    """Settings of a trial.

    Attributes:
        number: seed of all random draws.
        is_spoilt: the server is reached through `link_liar`.
        has_fallback: True with a second policy.
        kind: kind of the fault.
    """

    number: int
    is_spoilt: bool
    has_fallback: bool
    kind: str

    @classmethod
    def of(cls, number: int) -> Trial:
        """The trial of that number."""
        is_spoilt, has_fallback = number % 2 == 1, number // 2 % 2 == 1
        kinds = SPOILT if is_spoilt else DIRECT
        return cls(number, is_spoilt, has_fallback, kinds[number // 4 % len(kinds)])


class Site:
    """The other machine, its server, and the path to it; used inside the robot's machine.

    Args:
        folder: files created by the parent.
        facts: facts about the machines.
    """

    def __init__(self, folder: Path, facts: dict[str, Any], *, is_spoilt: bool) -> None:
        self.folder, self.facts, self.is_spoilt = folder, facts, is_spoilt
        site = folder / "server"
        site.mkdir(exist_ok=True)
        model = {
            "backend": "steady",
            "stateless": True,
            "options": {"rows": ROWS, "step_s": STEP_S},
        }
        listen = {"host": "0.0.0.0", "port": 7421 if is_spoilt else 7420}
        far = self

        class Far(RunningServer):
            def words(self) -> list[str]:
                return far.there(*super().words())

        self.server = Far(site, {"steady": model}, listen, Path(facts["gpu_state"]))
        self._liar: subprocess.Popen[bytes] | None = None

    def there(self, *words: str) -> list[str]:
        """The command line on the other machine."""
        return ["nsenter", "-t", str(self.facts["gpu_pid"]), "-n", "-m", *words]

    def start(self) -> None:
        """Start the processes on the other machine."""
        self.server.start()
        if self.is_spoilt:
            script = str(Path(__file__).with_name("link_liar.py"))
            states = (self.facts["gpu_state"], self.facts["robot_state"], self.facts["gpu_address"])
            words = self.there(sys.executable, script, str(self.folder), *states)
            self._liar = subprocess.Popen(words)

    def close(self) -> None:
        """End them."""
        if self._liar is not None:
            self._liar.kill()
            self._liar.wait(10.0)
        self.server.end()

    def spoil(self, mode: str) -> None:
        """Set the liar's mode; an empty mode changes nothing."""
        fresh = self.folder / "liar.new"
        fresh.write_text(mode)
        fresh.replace(self.folder / "liar")

    def lied(self) -> int:
        """Number of spoilt messages."""
        path = self.folder / "lied"
        return len(path.read_bytes()) if path.exists() else 0

    def _neighbour(self, words: Sequence[str], address: str, hardware: str) -> None:
        entry = [address, "lladdr", hardware, "dev", "cable", "nud", "permanent"]
        subprocess.run([*words, "ip", "neigh", "replace", *entry], check=True, timeout=60)

    def _lose(self, is_lost: bool, *, both: bool) -> None:
        wrong, facts = "02:00:00:00:00:99", self.facts
        here = wrong if is_lost else facts["gpu_hardware"]
        self._neighbour((), facts["gpu_address"], here)
        if both:
            there = wrong if is_lost else facts["robot_hardware"]
            self._neighbour(self.there(), facts["robot_address"], there)

    def _swap(self, whose: str) -> None:
        """Exchange the keys of a machine with those of a foreign machine."""
        own = link_of(Path(self.facts[f"{whose}_state"]))
        other = link_of(self.folder / f"stranger-{whose}")
        spare = own.with_name("link.spare")
        own.replace(spare)
        other.replace(own)
        spare.replace(other)
        (own / "link.json").touch()

    @contextlib.contextmanager
    def fault(self, kind: str) -> Iterator[None]:
        """Cause the fault until the context ends."""
        if kind in SPOILT:
            self.spoil(kind)
            try:
                yield
            finally:
                self.spoil("")
            return
        begin, end = self._of(kind)
        begin()
        try:
            yield
        finally:
            end()

    def _of(self, kind: str) -> tuple[Callable[[], object], Callable[[], object]]:
        def cable(state: str) -> Callable[[], object]:
            words = ["ip", "link", "set", "cable", state]
            return lambda: subprocess.run(words, check=True, timeout=60)

        def send(pid: int, number: int) -> Callable[[], object]:
            return lambda: os.kill(pid, number)

        if kind == "cable cut":
            return cable("down"), cable("up")
        if kind.startswith("packets lost"):
            both = kind.endswith("both ways")
            return lambda: self._lose(True, both=both), lambda: self._lose(False, both=both)
        if kind.startswith("keys swapped"):
            whose = "gpu" if kind.endswith("there") else "robot"
            return lambda: self._swap(whose), lambda: self._swap(whose)
        if kind == "server killed":
            return self.server.kill, lambda: self.server.start(is_ready=False)
        model = int(self.server.status()["models"]["steady"]["pid"])
        if kind == "model killed":
            return send(model, signal.SIGKILL), lambda: None
        pid = self.server.pid if kind == "server frozen" else model
        return send(pid, signal.SIGSTOP), send(pid, signal.SIGCONT)

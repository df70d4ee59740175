"""The append-only ledger of a policy that is improved in rounds: one line of JSON for each event.
An event that is not in it has not happened; the champion follows from it.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from roboneuron import (
    ForeignDataError,
    StateError,
    foreign,
)

LEDGER_FILE, LOCK_FILE = "ledger.jsonl", "improve.lock"
BEGUN, ROLLED_OUT, TRAINED, EVALUATED = "begun", "rolled_out", "trained", "evaluated"
PROMOTED, KEPT, ROLLED_BACK = "promoted", "kept", "rolled_back"
"""Events that end a round: the challenger was promoted, or the champion stays; and the event that
undoes a promotion.
"""
FIRST = 0
"""Round of the initial weights."""


@contextmanager
def alone_in(directory: Path) -> Iterator[None]:
    """Lock a directory for one process. Raises StateError while another one uses it."""
    directory.mkdir(parents=True, exist_ok=True)
    with (directory / LOCK_FILE).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StateError(
                f"Another process is improving the policy in {directory}.",
                hint="Wait until it has ended, or name another folder with --out.",
            ) from error
        yield


class ImprovementLedger:
    """A ledger on disk, used by one process at a time, see `alone_in`.

    Attributes:
        entries: entries of the file, in order.
    """

    def __init__(self, directory: Path) -> None:
        """Read the file. A line that was truncated by a crash is removed. Raises StateError if it
        is no ledger.
        """
        self._path = directory / LEDGER_FILE
        self.entries: list[dict[str, Any]] = []
        if not self._path.exists():
            return
        data = self._path.read_bytes()
        whole = data[: data.rfind(b"\n") + 1]
        if len(whole) < len(data):
            with self._path.open("r+b") as file:
                file.truncate(len(whole))
        try:
            self.entries = [
                foreign.table(foreign.decode_json(line, "a line", has_constants=True), "a line")
                for line in whole.splitlines()
            ]
        except ForeignDataError as error:
            raise StateError(
                f"{self._path} is no ledger: {error}.", hint="Name another folder with --out."
            ) from error

    def add(self, round_number: int, what: str, facts: Mapping[str, object]) -> None:
        """Append an event; it is on disk when this returns. Raises StateError."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        entry = {"at": now, "round": round_number, "what": what, **facts}
        try:
            with self._path.open("ab") as file:
                file.write(json.dumps(entry).encode() + b"\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise StateError(
                f"{self._path} cannot be written: {error.strerror or error}.",
                hint="Free space on that disk, and run the same command again to resume.",
            ) from error
        self.entries.append(entry)

    def of(self, round_number: int, what: str) -> dict[str, Any] | None:
        """The entry of an event in a round; None if it has not happened."""
        return next(
            (e for e in self.entries if e["round"] == round_number and e["what"] == what), None
        )

    @property
    def rounds(self) -> list[int]:
        """Numbers of the started rounds."""
        return [entry["round"] for entry in self.entries if entry["what"] == BEGUN]

    @property
    def unfinished(self) -> int | None:
        """The current round; None between rounds."""
        ended = {entry["round"] for entry in self.entries if entry["what"] in (PROMOTED, KEPT)}
        return next((number for number in self.rounds if number not in ended), None)

    @property
    def champions(self) -> list[int]:
        """Rounds of all champions that were not rolled back, the present one last; `FIRST` is the
        first.
        """
        found = [FIRST]
        for entry in self.entries:
            if entry["what"] == PROMOTED:
                found.append(entry["round"])
            elif entry["what"] == ROLLED_BACK:
                found.remove(entry["round"])
        return found

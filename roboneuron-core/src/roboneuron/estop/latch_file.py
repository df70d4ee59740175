"""File of the emergency stop: its name, its content and its identity."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

from roboneuron import foreign
from roboneuron.errors import ForeignDataError
from roboneuron.log_files import printable, quoted

ESTOP_FILE = "emergency_stop.latched"
"""Name of the latch in the state directory."""
RESET_SUFFIX = ".reset"
"""Added to the latch's name by a reset."""
_MAX_BYTES = 16_384
"""Bytes read from the file: JSON needs up to 12 for each of the 700 of a cause."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LatchState:
    """Origin and reason of a stop.

    Attributes:
        time_ns: wall-clock time [ns], 0 if not in the file.
        restored: how often the file was written again after it had vanished without a reset.
    """

    latched: bool
    who: str = ""
    reason: str = ""
    time_ns: int = 0
    restored: int = 0

    @property
    def cause(self) -> str:
        """Origin and reason as text for a person; empty if unknown. The reason is in the words of
        who pressed it, which may be an agent, and so is quoted.
        """
        if not self.who:
            return ""
        who = printable(self.who, 100)
        told = f"{who}: {quoted(self.reason)}" if self.reason else who
        if self.restored:
            told += f" (its file vanished without a reset and was written again, {self.restored} x)"
        return told


def read_cause(path: Path) -> LatchState:
    """Read the cause from the file. Any user may have written it, so every part is optional."""
    try:
        # a person may have written it in another encoding
        told = foreign.read_bytes(path, most_bytes=_MAX_BYTES).decode("utf-8", "replace")
        content = foreign.table(foreign.decode_json(told, ESTOP_FILE), ESTOP_FILE)
        return LatchState(
            latched=True,
            who=foreign.text(content.get("who"), "who", _MAX_BYTES)[:200],
            reason=foreign.text(content.get("reason"), "reason", _MAX_BYTES)[:500],
            time_ns=foreign.integer(content.get("time_ns"), "time_ns"),
            restored=foreign.integer(content.get("restored", 0), "restored"),
        )
    except (FileNotFoundError, ForeignDataError):
        return LatchState(latched=True)


def write_cause(descriptor: int, state: LatchState) -> None:
    """Write the cause into the open file. Raises OSError if the disk is full."""
    content = {name: value for name, value in asdict(state).items() if name != "latched"}
    content |= {name: foreign.encodable(content[name]) for name in ("who", "reason")}
    os.write(descriptor, json.dumps(content).encode())


def sync(path: Path) -> None:
    """Flush a file or directory to the disk. Raises OSError on failure."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

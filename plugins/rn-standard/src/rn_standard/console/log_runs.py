"""Log directories of server runs below a state directory, and their files."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

_NAME = re.compile(r"(\d{8}-\d{6})-(\d+)")
"""Local time and process id, see `roboneuron.supervisor.supervisor.Supervisor`."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LogRun:
    """One run of a server.

    Attributes:
        time: as in its name, "20260102-101500".
        pid: process id of the server.
    """

    time: str
    pid: int
    path: Path

    def files(self) -> dict[str, Path]:
        """Log files by module; "server" is the server's own."""
        return {path.stem: path for path in sorted(self.path.glob("*.log"))}


def log_runs(state_directory: Path) -> list[LogRun]:
    """All runs, newest first; of two begun within one second, the one with the latest write comes
    first.
    """
    found = []
    for path in (state_directory / "log").glob("*/"):
        if name := _NAME.fullmatch(path.name):
            found.append(
                (
                    name[1],
                    path.stat().st_mtime_ns,
                    LogRun(time=name[1], pid=int(name[2]), path=path),
                )
            )
    return [run for *_, run in sorted(found, key=lambda entry: entry[:2], reverse=True)]

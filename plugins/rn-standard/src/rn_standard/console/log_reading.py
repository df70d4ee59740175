"""Log files of one run, merged by time, and followed while they grow."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.text import Text

from rn_standard.console.interrupt import lasting_interrupt
from rn_standard.console.log_runs import LogRun, log_runs
from roboneuron import ConfigurationError, foreign

_MOST_LINE = 10_000
_STAMP = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} ([A-Z]+) ")
"""Beginning of an entry, see `roboneuron.log_files.FORMAT`; other lines belong to the previous
entry.
"""
_STYLES = {"WARNING": "yellow", "ERROR": "red", "CRITICAL": "bold red", "DEBUG": "dim"}
_COLOURS = {
    "robot": "cyan",
    "perception": "magenta",
    "inference": "green",
    "control": "blue",
    "server": "white",
}
_LOOK_S = 0.2


def choose_run(state_directory: Path, name: str | None) -> LogRun:
    """Return the run of that name, or the newest.

    Raises:
        ConfigurationError: there is none.
    """
    runs = log_runs(state_directory)
    if not runs:
        raise ConfigurationError(
            f"No server has logged below {state_directory} yet.",
            hint="Start one, or name another with --state.",
        )
    found = next((run for run in runs if name in (None, run.path.name)), None)
    if found is None:
        raise ConfigurationError(
            f"There is no run {name!r}.", hint="`roboneuron logs --runs` lists them."
        )
    return found


@dataclass(kw_only=True, slots=True)
class _File:
    """Read position in a file."""

    path: Path
    module: str
    offset: int = 0
    inode: int = 0
    stamp: str = ""
    rest: bytes = b""

    def read_lines(self) -> Iterator[tuple[str, str, str]]:
        """Yield (time, module, line) for each complete line since the last call; from the beginning
        in a new file.
        """
        try:
            with self.path.open("rb") as file:
                facts = self.path.stat()
                if facts.st_ino != self.inode or facts.st_size < self.offset:
                    self.offset, self.inode, self.rest = 0, facts.st_ino, b""
                file.seek(self.offset)
                data = file.read()
        except FileNotFoundError:
            return
        self.offset += len(data)
        *lines, self.rest = (self.rest + data).split(b"\n")
        for raw in lines:
            line = raw.decode("utf-8", errors="replace")
            if entry := _STAMP.match(line):
                self.stamp = line[: entry.start(1) - 1]
            yield self.stamp, self.module, line


class LogView:
    """Shows one run.

    Args:
        module: the module whose log is shown; None for all.

    Raises:
        ConfigurationError: the run has no log of it.
    """

    def __init__(self, run: LogRun, module: str | None, console: Console) -> None:
        self._run = run
        self._module = module
        self._console = console
        self._files: dict[str, _File] = {}
        self._style = ""
        if module is not None and module not in run.files():
            there = ", ".join(run.files()) or "nothing"
            raise ConfigurationError(
                f"The run {run.path.name} has no log of {module}.", hint=f"It has: {there}."
            )

    def show_last(self, count: int) -> None:
        """Print the newest `count` lines, 0 for all."""
        lines = self._new_lines()
        self._console.print(Text(f"{self._run.path}", style="dim"), soft_wrap=True)
        self._print(lines[-count:] if count else lines)

    def follow(self, newest_below: Path | None) -> None:
        """Print new lines until interrupted; with a state directory, switch to a newer run when one
        begins.

        Raises:
            KeyboardInterrupt: on Ctrl-C, also where Python would lose it.
        """
        with lasting_interrupt() as interrupted:
            while True:
                time.sleep(_LOOK_S)
                if interrupted():
                    raise KeyboardInterrupt
                self._follow_once(newest_below)

    def _follow_once(self, newest_below: Path | None) -> None:
        self._print(self._new_lines())
        if newest_below is None:
            return
        newest = next(iter(log_runs(newest_below)), self._run)
        if newest.time > self._run.time:
            self._run, self._files = newest, {}
            self._console.print(Text(f"{newest.path}", style="dim"), soft_wrap=True)

    def _new_lines(self) -> list[tuple[str, str, str]]:
        for name, path in self._run.files().items():
            if self._module in (None, name):
                self._files.setdefault(name, _File(path=path, module=name))
        found = [line for file in self._files.values() for line in file.read_lines()]
        return sorted(found, key=lambda line: line[0])  # stable: lines of one file keep their order

    def _print(self, lines: list[tuple[str, str, str]]) -> None:
        width = max((len(name) for name in _COLOURS), default=0)
        for _, module, line in lines:
            if entry := _STAMP.match(line):
                self._style = _STYLES.get(entry[1], "")
            prefix = (
                (f"{module:<{width}} ", _COLOURS.get(module, "")) if self._module is None else ""
            )
            self._console.print(
                Text.assemble(prefix, (foreign.printable(line, _MOST_LINE), self._style)),
                soft_wrap=True,
            )

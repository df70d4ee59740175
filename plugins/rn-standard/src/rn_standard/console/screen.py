"""What a person sees of a run: a line for each step; on a terminal, what goes on at the moment
below them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.text import Text


class CommandScreen:
    """Writes lines to a console.

    Args:
        is_quiet: only the last line of the run is shown.
    """

    def __init__(self, console: Console, is_quiet: bool) -> None:
        self._console = console
        self._is_quiet = is_quiet

    def title(self, text: str) -> None:
        """What is going to happen."""
        self._line(Text(text, style="bold"))

    def say(self, text: str) -> None:
        """Something has happened."""
        self._line(Text(f"    {text}"))

    def warn(self, text: str) -> None:
        """Something went wrong that does not end the run."""
        self._line(Text(f"  ! {text}", style="yellow"))

    def end(self, is_done: bool, text: str) -> None:
        """How the run went."""
        self._console.print(
            Text(text, style="bold green" if is_done else "bold red"), soft_wrap=True
        )

    @contextmanager
    def step(self, what: str) -> Iterator[Callable[[str], None]]:
        """A step of the run; call what is given with what goes on during it."""
        started_s = time.monotonic()
        with self.live(what) as update:
            try:
                yield lambda text: update(f"{what}: {text.partition(': ')[2] or text}")
            except BaseException:
                self._line(Text.assemble(("  ✗ ", "bold red"), what))
                raise
        took = f"{time.monotonic() - started_s:.1f} s"
        self._line(Text.assemble(("  ✓ ", "bold green"), what, (f"  {took}", "dim")))

    @contextmanager
    def live(self, text: str) -> Iterator[Callable[[str], None]]:
        """A line that is written anew again and again, on a terminal; call what is given with its
        text.
        """
        if self._is_quiet or not self._console.is_terminal:
            yield lambda text: None
            return
        # a spinner of ASCII letters
        with self._console.status(Text(text), spinner="line") as status:
            yield lambda text: status.update(Text(text))

    def _line(self, text: Text) -> None:
        if not self._is_quiet:
            self._console.print(text, soft_wrap=True)

"""Terminal output of a run: a line for each step, and below them on a terminal the present
activity.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.text import Text


class CommandScreen:
    """Writer of lines to a console.

    Args:
        is_quiet: show only the last line of the run.
    """

    def __init__(self, console: Console, is_quiet: bool) -> None:
        self._console = console
        self._is_quiet = is_quiet

    def title(self, text: str) -> None:
        """Print the title of the run."""
        self._line(Text(text, style="bold"))

    def say(self, text: str) -> None:
        """Print an event."""
        self._line(Text(f"    {text}"))

    def warn(self, text: str) -> None:
        """Print a problem that does not end the run."""
        self._line(Text(f"  ! {text}", style="yellow"))

    def end(self, is_done: bool, text: str) -> None:
        """Print the outcome of the run."""
        self._console.print(
            Text(text, style="bold green" if is_done else "bold red"), soft_wrap=True
        )

    @contextmanager
    def step(self, what: str) -> Iterator[Callable[[str], None]]:
        """Show a step of the run; call the yielded function with the progress."""
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
        """Show a line that is rewritten repeatedly on a terminal; call the yielded function with
        its text.
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

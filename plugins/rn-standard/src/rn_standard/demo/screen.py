"""Terminal output of the demo: steps with ticks, a live line per module, a final table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

LIFT_GOAL_M = 0.10
HOLD_GOAL_S = 1.0
_MODULES = ("robot", "perception", "control", "inference")


class DemoScreen:
    """Writer to one console; independent of the robot."""

    def __init__(self, console: Console) -> None:
        self.console = console

    def title(self, instruction: str, seed: int | None) -> None:
        """Print the title."""
        scene = "the configured scene" if seed is None else f"scene {seed}"
        self.console.print()
        self.console.print(
            Panel(
                Text.assemble(
                    ("An agent asks a simulated robot to ", ""),
                    (f"{instruction}", "bold"),
                    f"  ({scene})",
                ),
                title="[bold]RoboNeuron[/bold]",
                border_style="cyan",
                expand=False,
            )
        )

    @contextmanager
    def step(self, what: str) -> Iterator[list[str]]:
        """Show a spinner while the block runs, then a tick and the text it appended to the list; a
        cross if it fails.
        """
        told: list[str] = []
        try:
            with self.console.status(f"{what} …", spinner="dots"):
                yield told
        except BaseException:
            self.console.print(Text.assemble(("  ✗ ", "bold red"), what))
            raise
        note = f"  {told[0]}" if told else ""
        self.console.print(
            Text.assemble(("  ✓ ", "bold green"), what, (note, "dim")), highlight=False
        )

    def say(self, text: str) -> None:
        """Print one indented line."""
        self.console.print(f"    {text}", style="dim", highlight=False)

    @contextmanager
    def watching(self) -> Iterator[Live]:
        """Show a live area for `progress`."""
        with Live(console=self.console, refresh_per_second=5, transient=True) as live:
            yield live

    def progress(
        self, name: str, lifted_m: float, held_s: float, note: str, elapsed_s: float
    ) -> Group:
        """Progress of the named object."""
        lift = Table.grid(padding=(0, 1))
        lift.add_row(
            "    lifted", _bar(lifted_m, LIFT_GOAL_M), f"{max(0.0, lifted_m) * 100:5.1f} cm"
        )
        lift.add_row("    held", _bar(held_s, HOLD_GOAL_S), f"{held_s:5.1f} s")
        head = Text.assemble(
            (f"    {elapsed_s:4.0f} s  ", "dim"),
            (note or "…", "bold"),
            (f"   [{name} cube]", "dim"),
        )
        return Group(head, lift)

    def summary(self, modules: Sequence[Mapping[str, object]]) -> None:
        """Rates and latencies of the modules during the run."""
        table = Table(
            title="While it worked", title_style="bold", title_justify="left", header_style="dim"
        )
        table.add_column("process", no_wrap=True)
        for column in ("pid", "rate", "median", "p99", "sent", "dropped"):
            table.add_column(column, justify="right", no_wrap=True)
        for name in _MODULES:
            module = next((m for m in modules if m.get("module") == name), None)
            if module is None:
                continue
            table.add_row(
                name,
                str(module.get("pid", "")),
                _unit(module.get("rate_hz"), "Hz", 1),
                _unit(module.get("latency_ms"), "ms", 1),
                _unit(module.get("latency_p99_ms"), "ms", 1),
                str(module.get("published", "")),
                str(module.get("dropped", "")),
            )
        self.console.print()
        self.console.print(table)
        self.console.print(
            "  median and p99: from capture to image (perception) or action (inference),\n"
            "  from action to command (control), from command to its execution (robot)",
            style="dim",
        )


def _bar(value: float, goal: float) -> ProgressBar:
    return ProgressBar(total=1.0, completed=min(1.0, max(0.0, value / goal)), width=30)


def _unit(value: object, unit: str, digits: int) -> str:
    return "" if not isinstance(value, int | float) else f"{float(value):.{digits}f} {unit}"

"""A server's status as a table; plain text if the output is not a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from rn_standard.console.status import ReportedModule, ServerStatus
from roboneuron import foreign
from roboneuron.feature import EXPLANATIONS

_COLOURS = {
    "ok": "green",
    "waiting": "yellow",
    "starting": "yellow",
    "stopping": "yellow",
    "stopped": "dim",
}
_PLAIN_WIDTH = 110
_UNBOUNDED = 1000
_COLUMNS = ("pid", "up", "Hz", "ms", "p99 ms", "age ms", "sent", "dropped")
_DISPENSABLE = ("sent", "p99 ms", "pid", "up", "dropped", "age ms", "ms", "Hz")
"""Columns in the order in which they are dropped on a narrow terminal."""


def make_console(*, stderr: bool = False) -> Console:
    """Create a console for this terminal; otherwise without colours and wide enough for the
    table.
    """
    console = Console(highlight=False, stderr=stderr, emoji=False, markup=False)
    if not console.is_terminal:
        console.width = max(console.width, _PLAIN_WIDTH)
    return console


def status_view(statuses: Sequence[ServerStatus]) -> RenderableType:
    """The complete output of `roboneuron status`."""
    parts: list[RenderableType] = []
    for status in statuses:
        parts += [_head(status), *_body(status)]
    return Group(*parts)


def _head(status: ServerStatus) -> Text:
    robot = f"/{status.namespace}" if status.namespace else "no robot"
    words = [robot]
    if status.pid is not None:
        words.append(f"server pid {status.pid}")
    if status.uptime_s is not None:
        words.append(f"up {duration(status.uptime_s)}")
    head = Text.assemble((", ".join(words), "bold"), (f"  ({status.source})", "dim"))
    others = [one for one in status.why_still if one.rule != "emergency_stop"]
    lines = [f"\n{foreign.printable(f'{one.message} {one.hint}')}" for one in others]
    why = ("".join(lines), "yellow")
    if status.emergency_stop:
        cause = f" by {status.emergency_stop_cause}" if status.emergency_stop_cause else ""
        return Text.assemble(head, "\n", (f"EMERGENCY STOP latched{cause}", "bold red"), why)
    return Text.assemble(head, "\n", "emergency stop: not latched", why)


def _body(status: ServerStatus) -> list[RenderableType]:
    if not status.running:
        return [Text("no module runs")]
    remarks = [remark for module in status.running for remark in _remarks(module)]
    return [_ModuleTable(status.modules), *remarks]


class _ModuleTable:
    """One line for each module, with as many columns as fit: a number is shown completely or not at
    all.
    """

    def __init__(self, modules: Sequence[ReportedModule]) -> None:
        self._modules = modules

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        left_out: list[str] = []
        for name in ("", *_DISPENSABLE):
            left_out += [name] if name else []
            table = self._table([column for column in _COLUMNS if column not in left_out])
            if (
                Measurement.get(console, options.update(max_width=_UNBOUNDED), table).maximum
                <= options.max_width
            ):
                break
        yield table
        if left_out:
            yield Text(f"no room for: {', '.join(left_out)} (--json has all)", style="dim")

    def _table(self, columns: Sequence[str]) -> Table:
        # fits 80 columns
        table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 1, 0, 0))
        table.add_column("module", no_wrap=True, overflow="crop")
        table.add_column("health", no_wrap=True, overflow="crop")
        for column in columns:
            table.add_column(column, justify="right", no_wrap=True, overflow="crop")
        for module in self._modules:
            health = Text(module.health, style=_COLOURS.get(module.health, "bold red"))
            cells = dict(zip(_COLUMNS, _cells(module), strict=True))
            table.add_row(module.module, health, *(cells[column] for column in columns))
        return table


def _cells(module: ReportedModule) -> list[str]:
    if module.health == "stopped":
        return ["-"] * len(_COLUMNS)
    uptime = duration(module.uptime_s) if module.uptime_s is not None else "-"
    numbers = (module.rate_hz, module.latency_ms, module.latency_p99_ms, module.age_ms)
    cells = [f"{value:.1f}" if value is not None else "-" for value in numbers]
    return [str(module.pid or "-"), uptime, *cells, str(module.published), str(module.dropped)]


def _remarks(module: ReportedModule) -> list[Text]:
    """Remarks beyond the numbers, one line each."""
    words = []
    if module.instruction:
        words.append(Text(f"{module.module}: instruction {module.instruction!r}"))
    if module.note:
        words.append(Text(f"{module.module}: {module.note}"))
    if module.waiting_for:
        words.append(Text(f"{module.module}: waits for {module.waiting_for}", style="yellow"))
    if module.is_faulty or module.error is not None:
        words.append(Text(f"{module.module}: {fault_text(module)}", style="red"))
    return words


def fault_text(module: ReportedModule) -> str:
    """Fault of a module, in one line."""
    if module.error is not None and module.error.message:
        return " ".join(f"{module.error.message} {module.error.hint}".split())
    return next(
        (text for health, text in EXPLANATIONS.items() if health == module.health), module.health
    )


def duration(seconds: float) -> str:
    """Format a duration, such as "45 s", "3:20" or "2:03:20"."""
    whole = int(seconds)
    if whole < 60:
        return f"{whole} s"
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02}:{whole % 60:02}" if hours else f"{minutes}:{whole % 60:02}"

"""Progress display of a run: rate, remaining time, success with its interval."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from rn_eval.plan import Variant
from rn_eval.record import EpisodeRecord
from rn_eval.statistics import proportion

_LINE_S = 10.0
"""Interval of the lines that are printed without a terminal."""


def label(variant: Variant, variants: tuple[Variant, ...]) -> str:
    """A variant's name: its distinguishing values, or the preset if there is only one variant."""
    differing = [name for name in Variant._fields if len({getattr(v, name) for v in variants}) > 1]
    return " ".join(getattr(variant, name) for name in differing or ["preset"])


class ProgressView:
    """A bar and a table in a terminal, one line every 10 s elsewhere. A context manager."""

    def __init__(
        self,
        console: Console,
        variants: tuple[Variant, ...],
        total: int,
        records: list[EpisodeRecord],
    ) -> None:
        self._console, self._variants, self._total = console, variants, total
        self._counts: dict[Variant, list[int]] = {variant: [0, 0, 0] for variant in variants}
        for record in records:
            self._count(record)
        self._done_before = len(records)
        self._done = len(records)
        self._begun_s = self._printed_s = time.monotonic()
        self._bar = Progress(
            TextColumn("episodes"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[pace]}"),
            TimeElapsedColumn(),
            console=console,
        )
        self._task = self._bar.add_task("", total=total, completed=self._done, pace="")
        self._live = Live(console=console, refresh_per_second=4) if console.is_terminal else None

    def __enter__(self) -> ProgressView:
        if self._live is not None:
            self._live.start()
            self._show()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._show()
            self._live.stop()

    def add(self, record: EpisodeRecord) -> None:
        """Count a finished episode."""
        self._count(record)
        self._done += 1
        now_s = time.monotonic()
        if self._live is not None:
            self._show()
        elif now_s - self._printed_s >= _LINE_S:
            self._printed_s = now_s
            shares = ", ".join(
                f"{label(v, self._variants)} {self._share(v)}"
                for v in self._variants
                if self._ran(v)
            )
            self._console.print(
                f"{self._done}/{self._total} episodes, {self._pace()}; {shares}", soft_wrap=True
            )

    def _count(self, record: EpisodeRecord) -> None:
        counts = self._counts.setdefault(record.key.variant, [0, 0, 0])
        counts[("success", "failure", "error").index(record.outcome.status)] += 1

    def _ran(self, variant: Variant) -> int:
        return sum(self._counts[variant])

    def _share(self, variant: Variant) -> str:
        won, lost, _ = self._counts[variant]
        return str(proportion(won, won + lost))

    def _pace(self) -> str:
        """Rate and remaining time, from the episodes since this start."""
        done, passed_s = self._done - self._done_before, time.monotonic() - self._begun_s
        if not done:
            return "no episode has ended yet"
        left_s = (self._total - self._done) * passed_s / done
        left = (
            f"{left_s / 3600:.1f} h"
            if left_s >= 5400
            else f"{left_s / 60:.0f} min"
            if left_s >= 90
            else f"{left_s:.0f} s"
        )
        return f"{60 * done / passed_s:.1f} a minute, {left} left"

    def _show(self) -> None:
        assert self._live is not None
        self._bar.update(self._task, completed=self._done, pace=self._pace())
        table = Table(box=None, padding=(0, 2, 0, 0))
        for title in ("variant", "episodes", "errors", "success, 95 % interval"):
            table.add_column(title)
        for variant in self._variants:
            errors = self._counts[variant][2]
            table.add_row(
                label(variant, self._variants),
                str(self._ran(variant)),
                str(errors),
                self._share(variant),
            )
        self._live.update(Group(self._bar, table))

"""Report of a check, for users and for programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from rn_recorder_policy.answers import Answers
from rn_recorder_policy.asking import BackendReplies
from rn_recorder_policy.diagnosis import Diagnosis
from rn_recorder_policy.measures import ChannelMeasures, measure

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True, kw_only=True, slots=True)
class CheckReport:
    """One check.

    Attributes:
        source: the episode, for messages.
        backend: its name.
        robot: its name.
    """

    source: str
    backend: str
    robot: str
    asked: BackendReplies
    diagnosis: Diagnosis

    @property
    def answers(self) -> Answers:
        """The compared answers."""
        return self.asked.answers

    def measures(self) -> list[ChannelMeasures]:
        """Measures of each channel."""
        return measure(self.answers, self.diagnosis.expected)

    def to_dict(self) -> dict[str, object]:
        """Convert to JSON values; unknown numbers are null."""
        answers = self.answers
        return {
            "source": self.source,
            "backend": self.backend,
            "robot": self.robot,
            "space": answers.space.label,
            "frames": len(answers.frames),
            "refused": self.asked.refused,
            "refusal": self.asked.refusal,
            "rows_per_answer": answers.horizon,
            "backend_hz": 1.0 / answers.step_s,
            "recorded_hz": answers.fps,
            "agrees": not self.diagnosis.faults,
            "faults": [asdict(fault) for fault in self.diagnosis.faults],
            "channels": [
                {
                    name: None if isinstance(value, float) and not np.isfinite(value) else value
                    for name, value in one.to_dict().items()
                }
                for one in self.measures()
            ],
        }


def show(report: CheckReport) -> None:
    """Print a table and the findings."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False, soft_wrap=True)
    answers = report.answers
    console.print(
        Text(
            f"{report.backend} on {report.robot}: {len(answers.frames)} frames of {report.source}, "
            f"{answers.horizon} rows each\n"
        )
    )
    suspects = {key for fault in report.diagnosis.faults for key in fault.channels}
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("CHANNEL", no_wrap=True)
    for column in ("RMS ERROR", "OF SPREAD", "SCALE", "OFFSET", "CORRELATION", "LAG"):
        table.add_column(column, justify="right", no_wrap=True)
    for one in report.measures():
        style = "red" if one.channel in suspects else ""
        table.add_row(*(Text(cell, style=style) for cell in _cells(one)))
    console.print(table)
    _show_faults(report, console)
    if report.asked.refused:
        console.print(
            Text(f"{report.asked.refused} frames were refused, the first: {report.asked.refusal}")
        )


def _show_faults(report: CheckReport, console: Console) -> None:
    from rich.text import Text

    faults = report.diagnosis.faults
    if not faults:
        console.print(Text("\nThe answers agree with the recorded actions.", style="green"))
        return
    console.print(Text("\nProbably wired wrong:", style="bold red"))
    for fault in faults:
        console.print(Text(f"  {fault.kind}: {fault.text}"))
        console.print(Text(f"    {fault.remedy}", style="dim"))
    before, after = report.diagnosis.before, report.diagnosis.after
    whole = float(np.nanmean(before))
    if whole > 0.0:
        share = max(0.0, 1.0 - float(np.nanmean(after)) / whole)
        console.print(Text(f"This explains {share:.0%} of the difference."))


def _cells(one: ChannelMeasures) -> Sequence[str]:
    def told(value: float | None, form: str) -> str:
        return "-" if value is None or not np.isfinite(value) else format(value, form)

    moves = one.scale is not None and one.spread > 0.0
    return (
        one.channel,
        f"{told(one.rms_error, '.3g')} {one.unit}",
        f"{one.rms_error / one.spread:.0%}" if moves else "still",
        told(one.scale, ".3g"),
        told(None if one.offset is None else round(one.offset, 9) + 0.0, "+.3g"),
        told(one.correlation, ".2f"),
        told(one.lag_rows, "+d"),
    )

"""Plots of a report as SVG: success by variant, against tokens kept, against latency, and against
speed-up.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from rn_eval.latency import median_s
from rn_eval.progress import label
from rn_eval.statistics import Proportion
from rn_eval.summary import Summary, SummaryRow

_SIZE = (6.4, 3.6)
_MARKERS = "os^DvPX<>*"
_LEVEL_LETTERS = 60
"""Maximum number of letters below the bars before labels overlap."""


def plots(summary: Summary) -> list[tuple[str, str]]:
    """Caption and SVG of each plot for which the records have data."""
    made = [
        (
            "Success by variant, with 95 % Wilson intervals",
            _draw(lambda axes: _bars(axes, summary.rows)),
        )
    ]
    with_tokens = [row for row in summary.rows if row.tokens is not None]
    if len({row.tokens for row in with_tokens}) > 1:
        made.append(("Success against tokens kept", _draw(lambda axes: _tokens(axes, with_tokens))))
    if len({row.variant.latency for row in summary.rows}) > 1:
        made.append(("Success against latency", _draw(lambda axes: _latency(axes, summary.rows))))
    faster = [row for row in summary.rows if row.speed_up is not None]
    if len({row.variant.preset for row in faster}) > 1:
        made.append(
            ("Speed-up of a prediction against success", _draw(lambda axes: _speed(axes, faster)))
        )
    return made


def _draw(paint: Callable[[Axes], None]) -> str:
    figure = Figure(figsize=_SIZE, layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    paint(axes)
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def _whiskers(shares: Sequence[Proportion]) -> list[list[float]]:
    below = [100 * max(0.0, s.share - s.low) if s.trials else 0.0 for s in shares]
    above = [100 * max(0.0, s.high - s.share) if s.trials else 0.0 for s in shares]
    return [below, above]


def _points(shares: Sequence[Proportion]) -> list[float]:
    return [100 * share.share for share in shares]


def _percent(axes: Axes) -> None:
    axes.set_ylim(-3, 103)
    axes.set_ylabel("success [%]")
    axes.grid(axis="y", alpha=0.3)


def _line(row: SummaryRow, rows: Sequence[SummaryRow], along: str) -> str:
    """Name of the line through variants that differ in one respect only."""
    variants = tuple(r.variant._replace(**{along: ""}) for r in rows)
    return label(row.variant._replace(**{along: ""}), variants)


def _legend(axes: Axes) -> None:
    """Legend above the plot, where it covers no point; omitted for a single line."""
    if len(axes.get_legend_handles_labels()[0]) > 1:
        axes.figure.legend(loc="outside upper center", ncols=3, frameon=False)


def _bars(axes: Axes, rows: Sequence[SummaryRow]) -> None:
    shares = [row.success for row in rows]
    axes.bar(range(len(rows)), _points(shares), color="#5a7fb5", width=0.6)
    axes.errorbar(
        range(len(rows)),
        _points(shares),
        yerr=_whiskers(shares),
        fmt="none",
        ecolor="black",
        capsize=4,
    )
    names = [row.name for row in rows]
    is_level = len(rows) <= 4 and sum(len(name) + 2 for name in names) <= _LEVEL_LETTERS
    axes.set_xticks(
        range(len(rows)),
        names,
        rotation=0 if is_level else 25,
        ha="center" if is_level else "right",
    )
    _percent(axes)


def _tokens(axes: Axes, rows: Sequence[SummaryRow]) -> None:
    for key in dict.fromkeys(row.variant[1:] for row in rows):
        own = sorted((r for r in rows if r.variant[1:] == key), key=lambda row: row.tokens or 0.0)
        shares = [row.success for row in own]
        axes.errorbar(
            [np.nan if r.tokens is None else r.tokens for r in own],
            _points(shares),
            yerr=_whiskers(shares),
            marker="o",
            capsize=4,
            label=_line(own[0], rows, "preset"),
        )
    axes.set_xlabel("tokens kept")
    _legend(axes)
    _percent(axes)


def _latency(axes: Axes, rows: Sequence[SummaryRow]) -> None:
    for preset, execution in dict.fromkeys(
        (row.variant.preset, row.variant.execution) for row in rows
    ):
        own = [r for r in rows if (r.variant.preset, r.variant.execution) == (preset, execution)]
        own.sort(key=_latency_ms)
        shares = [row.success for row in own]
        axes.errorbar(
            [_latency_ms(r) for r in own],
            _points(shares),
            yerr=_whiskers(shares),
            marker="o",
            capsize=4,
            label=_line(own[0], rows, "latency"),
        )
    axes.set_xlabel("latency of a prediction, median [ms]")
    _legend(axes)
    _percent(axes)


def _latency_ms(row: SummaryRow) -> float:
    """The injected median, or the measured one if none is injected."""
    injected_s = median_s(row.variant.latency)
    return row.inference.p50 if injected_s is None else 1e3 * injected_s


def _speed(axes: Axes, rows: Sequence[SummaryRow]) -> None:
    """Plot with the names in the legend, because presets are often equally fast and good and labels
    would overlap.
    """
    for row, marker in zip(rows, cycle(_MARKERS)):
        share = [row.success]
        axes.errorbar(
            [np.nan if row.speed_up is None else row.speed_up],
            _points(share),
            yerr=_whiskers(share),
            fmt=marker,
            capsize=4,
            label=row.name,
            alpha=0.8,
        )
    _legend(axes)
    known = [row.speed_up for row in rows if row.speed_up is not None]
    # because a difference of one per cent must not look large
    axes.set_xlim(min(0.8, *known) - 0.1, max(1.2, *known) + 0.2)
    axes.set_xlabel("speed-up of a prediction")
    _percent(axes)

"""Plots of actions, latencies and rates over the last seconds."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rn_view.source import PageState

if TYPE_CHECKING:
    import viser

F64 = NDArray[np.float64]
SPAN_S = 30.0
_MOST_POINTS = 240
_COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd")
_KINDS = ("robot", "perception", "inference", "control")
_HEIGHT_PX = 130


class History:
    """Rates and latencies of the modules over the last seconds, taken from snapshots; shared by all
    pages.
    """

    def __init__(self) -> None:
        self._rows: deque[tuple[float, dict[str, float], dict[str, float]]] = deque(
            maxlen=_MOST_POINTS
        )

    def add(self, snapshot: PageState, now_s: float) -> None:
        """Keep what a snapshot says; what is later than `now_s`, the time of what is shown, was
        before a jump back.
        """
        while self._rows and self._rows[-1][0] > now_s:
            self._rows.pop()
        rates = {row.kind: row.rate_hz for row in snapshot.modules if row.rate_hz is not None}
        latencies = {
            row.kind: row.latency_ms for row in snapshot.modules if row.latency_ms is not None
        }
        self._rows.append((now_s, rates, latencies))

    def series(self, index: int, now_s: float) -> tuple[F64, ...]:
        """Ages [s] and values of each module: 1 for rates [Hz], 2 for latencies [ms]; 0 where
        nothing was said.
        """
        rows = [row for row in list(self._rows) if now_s - row[0] <= SPAN_S]
        ages = np.array([row[0] - now_s for row in rows])
        values = [np.array([_value(row, index, kind) for row in rows]) for kind in _KINDS]
        return (ages, *values)


def _value(row: tuple[float, dict[str, float], dict[str, float]], index: int, kind: str) -> float:
    table = row[1] if index == 1 else row[2]
    return table.get(kind, 0.0)


class Plots:
    """The plots of one page."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._translation = _plot(gui, "action: translation [mm]", ("dx", "dy", "dz"))
        self._rotation = _plot(gui, "action: rotation [deg]", ("rx", "ry", "rz"))
        self._latency = _plot(gui, "latency [ms]; 0: not said", _KINDS)
        self._rate = _plot(gui, "rate [Hz]", _KINDS)

    def update(
        self, actions: Sequence[tuple[float, tuple[float, ...]]], history: History, now_s: float
    ) -> None:
        """Show the newest values; `now_s` as of `Source.now_s`."""
        rows = [row for row in actions if now_s - row[0] <= SPAN_S and len(row[1]) == 7]
        rows = rows[:: 1 + len(rows) // _MOST_POINTS]
        ages = np.array([at_s - now_s for at_s, _ in rows])
        values = np.array([row for _, row in rows]).reshape(-1, 7)
        self._translation.data = _filled((ages, *(values[:, :3].T * 1000.0)))
        self._rotation.data = _filled((ages, *np.degrees(values[:, 3:6]).T))
        self._latency.data = _filled(history.series(2, now_s))
        self._rate.data = _filled(history.series(1, now_s))


def _plot(gui: viser.GuiApi, title: str, names: Sequence[str]) -> viser.GuiUplotHandle:
    from viser import uplot

    series = [
        uplot.Series(label="s"),
        *(uplot.Series(label=n, stroke=_COLOURS[i], width=1.5) for i, n in enumerate(names)),
    ]
    return gui.add_uplot(
        data=_filled(tuple(np.empty(0) for _ in series)),
        series=tuple(series),
        title=title,
        scales={"x": uplot.Scale(time=False, range=(-SPAN_S, 0.0)), "y": uplot.Scale(auto=True)},
        legend=uplot.Legend(show=True),
        height=_HEIGHT_PX,
    )


def _filled(data: tuple[F64, ...]) -> tuple[F64, ...]:
    """The data, or one point at zero: a plot needs at least one, and cannot scale one without a
    value.
    """
    if data[0].size:
        return data
    return (np.array([0.0]), *(np.array([0.0]) for _ in data[1:]))

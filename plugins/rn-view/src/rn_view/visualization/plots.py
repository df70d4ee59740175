"""Plots of actions, latencies and rates over the last seconds."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rn_view.sources.measured_topics import ShownAction
from rn_view.sources.source import MODULE_KINDS, PageState
from roboneuron import ACTION_LABEL, GRIPPER, channel_keys

if TYPE_CHECKING:
    import viser

F64 = NDArray[np.float64]
SPANS_S = {"5 s": 5.0, "30 s": 30.0, "2 min": 120.0}
SPAN_S = 30.0
_MOST_POINTS = 240
_KEPT_ROWS = 480
"""Snapshots of two minutes."""
_COLOURS = (
    *("#1f77b4", "#d62728", "#2ca02c", "#9467bd"),
    *("#ff7f0e", "#8c564b", "#e377c2", "#7f7f7f"),
)
_UNITS = {
    "joint_position": "rad or m",
    "joint_velocity": "rad/s or m/s",
    "joint_delta": "rad or m",
    "ee_pose": "m, quaternion",
}
"""Units of the channels, except grippers, by kind of control space."""
_HEIGHT_PX = 130
_BEHIND = 10.0
"""Order of these plots: after those of the actions."""


class History:
    """Rates and latencies of the modules over the last two minutes; shared by all pages."""

    def __init__(self) -> None:
        self._rows: deque[tuple[float, dict[str, float], dict[str, float]]] = deque(
            maxlen=_KEPT_ROWS
        )

    def add(self, snapshot: PageState, now_s: float) -> None:
        """Add a snapshot. Entries later than `now_s` are dropped, because the recording was
        rewound.
        """
        while self._rows and self._rows[-1][0] > now_s:
            self._rows.pop()
        rates = {row.kind: row.rate_hz for row in snapshot.modules if row.rate_hz is not None}
        latencies = {
            row.kind: row.latency_ms for row in snapshot.modules if row.latency_ms is not None
        }
        self._rows.append((now_s, rates, latencies))

    def series(self, index: int, now_s: float, span_s: float = SPAN_S) -> tuple[F64, ...]:
        """Ages [s], then the values of each module: rates [Hz] for index 1, latencies [ms] for
        index 2; 0 if a module reported none.
        """
        rows = [row for row in list(self._rows) if now_s - row[0] <= span_s]
        ages = np.array([row[0] - now_s for row in rows])
        values = [np.array([_value(row, index, kind) for row in rows]) for kind in MODULE_KINDS]
        return (ages, *values)


def _value(row: tuple[float, dict[str, float], dict[str, float]], index: int, kind: str) -> float:
    table = row[1] if index == 1 else row[2]
    return table.get(kind, 0.0)


class ActionPanel(NamedTuple):
    """Layout of one plot of actions.

    Attributes:
        names: labels of the channels.
        columns: of these channels in an action.
        scale: factor from the values to the plotted ones.
    """

    title: str
    names: tuple[str, ...]
    columns: tuple[int, ...]
    scale: float = 1.0


def action_panels(label: str) -> tuple[ActionPanel, ...]:
    """Plots for actions of the control space with this label."""
    if label == ACTION_LABEL:
        return (
            ActionPanel("action: translation [mm]", ("dx", "dy", "dz"), (0, 1, 2), 1000.0),
            ActionPanel(
                "action: rotation [deg]", ("rx", "ry", "rz"), (3, 4, 5), float(np.degrees(1.0))
            ),
        )
    kind = label.partition(":")[0].partition("@")[0]
    keys = channel_keys(label)
    grippers = tuple(i for i, key in enumerate(keys) if key.rpartition("/")[2] == GRIPPER)
    motion = tuple(i for i in range(len(keys)) if i not in grippers)
    told = kind.replace("_", " ")
    panels: list[ActionPanel] = []
    for arm in dict.fromkeys(_arm_of(keys[i]) for i in motion):
        own = tuple(i for i in motion if _arm_of(keys[i]) == arm)
        title = f"{arm or 'action'}: {told} [{_UNITS.get(kind, '?')}]"
        panels.append(ActionPanel(title, tuple(keys[i] for i in own), own))
    panels.append(ActionPanel("action: gripper [0..1]", tuple(keys[i] for i in grippers), grippers))
    return tuple(panel for panel in panels if panel.columns)


def _arm_of(key: str) -> str:
    """Arm in the key of a channel; "" for an only arm."""
    return key.rpartition("/")[0]


class Plots:
    """The plots of one page.

    Args:
        gui: of the page.
        place: container of the plots; entered again when the channels of the actions change.
    """

    def __init__(self, gui: viser.GuiApi, place: AbstractContextManager[object]) -> None:
        self._gui, self._place = gui, place
        self._label = ""
        self._span_s = SPAN_S
        with place:
            spans = gui.add_button_group(
                "Time span",
                tuple(SPANS_S),
                hint="Drag over a plot to zoom in. Press here, or double-click the plot, to reset.",
                order=-2.0,
            )
            self._still = gui.add_checkbox("Freeze plots", False, order=-1.0)
        spans.on_click(lambda _: self._show_span(SPANS_S[str(spans.value)]))
        self._actions: list[tuple[ActionPanel, viser.GuiUplotHandle]] = []
        self._show_channels(ACTION_LABEL)
        with place:
            self._latency = self._plot("latency [ms]; 0: not reported", MODULE_KINDS, order=_BEHIND)
            self._rate = self._plot("rate [Hz]", MODULE_KINDS, order=_BEHIND + 1.0)

    def update(self, actions: Sequence[ShownAction], history: History, now_s: float) -> None:
        """Show the newest values; `now_s` as `Source.now_s`."""
        if self._still.value:
            return
        label = actions[-1].label if actions else self._label
        if label != self._label:
            self._show_channels(label)
        size = len(channel_keys(label))
        rows = [
            row
            for row in actions
            if now_s - row.at_s <= self._span_s and row.label == label and len(row.values) == size
        ]
        rows = rows[:: 1 + len(rows) // _MOST_POINTS]
        ages = np.array([row.at_s - now_s for row in rows])
        values = np.array([row.values for row in rows]).reshape(-1, size)
        for panel, plot in self._actions:
            shown = values[:, panel.columns].T * panel.scale
            plot.data = _filled((ages, *shown))
        self._latency.data = _filled(history.series(2, now_s, self._span_s))
        self._rate.data = _filled(history.series(1, now_s, self._span_s))

    def _show_span(self, span_s: float) -> None:
        """Show this time span, and reset the zoom."""
        self._span_s = span_s
        self._still.value = False  # type: ignore[misc]
        for plot in (*(plot for _, plot in self._actions), self._latency, self._rate):
            plot.scales = _scales(span_s)

    def _show_channels(self, label: str) -> None:
        """Replace the plots by those for the present channels."""
        for _, plot in self._actions:
            plot.remove()
        self._label = label
        with self._place:
            self._actions = [
                (panel, self._plot(panel.title, panel.names, order=float(place)))
                for place, panel in enumerate(action_panels(label))
            ]

    def _plot(self, title: str, names: Sequence[str], *, order: float) -> viser.GuiUplotHandle:
        from viser import uplot

        series = [
            uplot.Series(label="s"),
            *(
                uplot.Series(label=n, stroke=_COLOURS[i % len(_COLOURS)], width=1.5)
                for i, n in enumerate(names)
            ),
        ]
        return self._gui.add_uplot(
            data=_filled(tuple(np.empty(0) for _ in series)),
            series=tuple(series),
            title=title,
            scales=_scales(self._span_s),
            legend=uplot.Legend(show=True),
            height=_HEIGHT_PX,
            order=order,
        )


def _scales(span_s: float) -> dict[str, viser.uplot.Scale]:
    from viser import uplot

    x = uplot.Scale(time=False, range=(-span_s, 0.0))
    return {"x": x, "y": uplot.Scale(auto=True)}


def _filled(data: tuple[F64, ...]) -> tuple[F64, ...]:
    """The data, or one point at zero if empty: a plot cannot set its scale without a value."""
    if data[0].size:
        return data
    return (np.array([0.0]), *(np.array([0.0]) for _ in data[1:]))

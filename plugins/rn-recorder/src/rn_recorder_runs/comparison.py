"""Result of a replay: differences by axis, the first divergence, a plot."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rn_recorder_runs.observations import Gaps
from rn_recorder_runs.replay import Compared
from roboneuron import ACTION_LABEL, MissingDependencyError, channel_keys, install_command

AXES = ("dx [m]", "dy [m]", "dz [m]", "rx [rad]", "ry [rad]", "rz [rad]", "gripper")
"""Axes of the default control space."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of all predictions of a replay.

    Attributes:
        predictions: number of compared ones.
        diverging: number of those that differ by more than the tolerance.
        axes: names of the channels.
        largest, mean: |difference| by axis, float64 (n,).
        first: number of the first diverging one; None for none.
        took_ms: median time of a replayed prediction.
        gaps: missing messages of the run.
    """

    predictions: int
    diverging: int
    axes: tuple[str, ...]
    largest: NDArray[np.float64]
    mean: NDArray[np.float64]
    first: int | None
    took_ms: float
    tolerance: float
    gaps: Gaps = field(default_factory=Gaps)

    def to_dict(self) -> dict[str, object]:
        """Convert to JSON values."""
        return {
            "predictions": self.predictions,
            "diverging": self.diverging,
            "tolerance": self.tolerance,
            "largest": dict(zip(self.axes, self.largest.tolist(), strict=True)),
            "mean": dict(zip(self.axes, self.mean.tolist(), strict=True)),
            "first_divergence": self.first,
            "median_prediction_ms": self.took_ms,
            "predictions_lost": self.gaps.predictions,
            "predictions_without_image": self.gaps.without_image,
        }


def compare(found: Sequence[Compared], tolerance: float, gaps: Gaps | None = None) -> Comparison:
    """Summarise a replay of at least one prediction."""
    axes = axes_of(found[0].label)
    differences = [np.abs(one.difference) for one in found if one.difference.size]
    every = np.concatenate(differences) if differences else np.zeros((1, len(axes)))
    diverging = [number for number, one in enumerate(found) if one.diverges(tolerance)]
    return Comparison(
        predictions=len(found),
        diverging=len(diverging),
        axes=axes,
        largest=every.max(axis=0),
        mean=every.mean(axis=0),
        first=diverging[0] if diverging else None,
        took_ms=float(np.median([one.took_s for one in found])) * 1e3,
        tolerance=tolerance,
        gaps=gaps or Gaps(),
    )


def axes_of(label: str) -> tuple[str, ...]:
    """Names of a control space's channels, for users."""
    return AXES if label == ACTION_LABEL else channel_keys(label)


def describe(comparison: Comparison, found: Sequence[Compared]) -> str:
    """Format for a terminal."""
    axes = comparison.axes
    width = max(10, *map(len, axes))
    lines = [f"{'axis':<{width}} {'largest':>12} {'mean':>12}"]
    for axis, largest, mean in zip(axes, comparison.largest, comparison.mean, strict=True):
        lines.append(f"{axis:<{width}} {largest:>12.3e} {mean:>12.3e}")
    if comparison.first is None:
        lines.append(
            f"All {comparison.predictions} predictions equal the recorded ones within "
            f"{comparison.tolerance:g}."
        )
    else:
        one = found[comparison.first]
        after_s = (one.at_ns - found[0].at_ns) / 1e9
        lines.append(
            f"{comparison.diverging} of {comparison.predictions} predictions differ by more than "
            f"{comparison.tolerance:g}; "
            f"the first is number {comparison.first}, {after_s:.2f} s after the beginning "
            f"({one.instruction!r})."
        )
        if one.error:
            lines.append(f"The replayed backend refused it: {one.error}")
        elif len(one.recorded) != len(one.replayed):
            lines.append(f"It has {len(one.replayed)} rows, the recorded one {len(one.recorded)}.")
        else:
            row, place = divmod(int(np.abs(one.difference).argmax()), len(axes))
            before, after = one.recorded[row, place], one.replayed[row, place]
            lines.append(f"Row {row}, {axes[place]}: {before:.6g} -> {after:.6g}")
    lines += _explain_gaps(comparison, found)
    lines.append(f"A replayed prediction took {comparison.took_ms:.1f} ms (median).")
    return "\n".join(lines)


def _explain_gaps(comparison: Comparison, found: Sequence[Compared]) -> list[str]:
    """Missing messages of the run, and their effect on the differences."""
    gaps = comparison.gaps
    if gaps.first_ns is None:
        return []
    parts = []
    if gaps.predictions:
        parts.append(
            f"{gaps.predictions} predictions (what the backend was asked then is not known)"
        )
    if gaps.without_image:
        parts.append(f"an image of {gaps.without_image} predictions (they were not compared)")
    after_s = (gaps.first_ns - found[0].at_ns) / 1e9
    lines = [
        f"The run lacks {' and '.join(parts)}, first {after_s:.2f} s after the beginning: lost "
        "while recording."
    ]
    if comparison.first is not None and found[comparison.first].at_ns >= gaps.first_ns:
        lines.append(
            "What differs comes after that: a backend that remembers goes on from another state "
            "there."
        )
    return lines


def write_report(directory: Path, found: Sequence[Compared], comparison: Comparison) -> None:
    """`comparison.json` and `comparison.png`, the first row of every prediction by axis.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    directory.mkdir(parents=True, exist_ok=True)
    text = json.dumps(comparison.to_dict(), indent=1)
    (directory / "comparison.json").write_text(text, encoding="utf-8")
    try:
        from matplotlib.figure import Figure  # heavy
    except ImportError as error:
        raise MissingDependencyError(
            "The plot needs matplotlib.",
            hint=f"Run: {install_command('rn-recorder[export]')}.",
        ) from error
    axes = comparison.axes
    figure = Figure(figsize=(10, 1.7 * len(axes)), layout="constrained")
    panels = figure.subplots(len(axes), 1, sharex=True, squeeze=False)[:, 0]
    times = [(one.at_ns - found[0].at_ns) / 1e9 for one in found]
    for axis, (panel, name) in enumerate(zip(panels, axes, strict=True)):
        for values, label, style in (
            ([_first(one.recorded, axis) for one in found], "recorded", "-"),
            ([_first(one.replayed, axis) for one in found], "replayed", "--"),
        ):
            panel.plot(times, values, style, label=label, linewidth=1.2)
        panel.set_ylabel(name)
        panel.grid(alpha=0.3)
        if comparison.first is not None:
            panel.axvline(times[comparison.first], color="tab:red", linewidth=0.8)
    panels[0].legend(loc="upper right")
    panels[-1].set_xlabel("time [s]; the red line is the first divergence")
    figure.savefig(directory / "comparison.png", dpi=110)


def _first(rows: NDArray[np.float64], axis: int) -> float:
    return float(rows[0, axis]) if len(rows) else float("nan")

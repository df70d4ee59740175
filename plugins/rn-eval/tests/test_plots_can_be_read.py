"""No text of a plot overlaps another one, even if variants are equally fast and good."""

from __future__ import annotations

from itertools import combinations

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from rn_eval import plots
from rn_eval.plan import Key
from rn_eval.record import EpisodeOutcome, EpisodeRecord, MachineFacts
from rn_eval.summary import summarise


def rows_of(presets, executions):
    """Variants with the same success rate and the same prediction time."""
    records = []
    for preset in presets:
        for execution in executions:
            for seed in range(4):
                key = Key(
                    suite="s",
                    preset=preset,
                    execution=execution,
                    latency="112ms",
                    task="t",
                    seed=seed,
                )
                outcome = EpisodeOutcome(status="success", metrics={"tokens_kept": 64.0})
                measured = MachineFacts(inference_ms=[9.0, 10.0, 10.0], cold=1)
                records.append(
                    EpisodeRecord(key=key, instruction="go", outcome=outcome, measured=measured)
                )
    return summarise(records).rows


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("paint", [plots._speed, plots._bars], ids=["speed-up", "bars"])
@pytest.mark.parametrize(
    ("presets", "executions"),
    [
        (("none", "fastv-p25", "fastv-p50", "fastv-p75"), ("sequential",)),
        (("none", "fastv-p50"), ("sequential", "predicted-state")),
        (("none", "fastv-p25", "fastv-p50", "fastv-p75"), ("sequential", "overlap")),
    ],
    ids=["presets", "long names", "both"],
)
def test_no_text_covers_another(paint, presets, executions):
    figure = Figure(figsize=plots._SIZE, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    paint(axes, rows_of(presets, executions))
    figure.draw_without_rendering()
    beyond = ("", "120", "\N{MINUS SIGN}20")  # ticks that are not drawn
    texts = [
        text
        for text in figure.findobj(Text)
        if text.get_visible() and text.get_text() not in beyond
    ]
    # bounding boxes of slanted texts are larger than the text
    is_level = [text for text in texts if text.get_rotation() in (0.0, 90.0)]
    boxes = [(text.get_text(), text.get_window_extent()) for text in is_level]
    covered = [(a, b) for (a, one), (b, other) in combinations(boxes, 2) if one.overlaps(other)]
    assert covered == []
    assert set(presets) <= {w for t in texts for w in t.get_text().split()}

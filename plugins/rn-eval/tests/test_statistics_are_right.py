"""Intervals and paired tests against published numbers; the report shows the ledger's content."""

from __future__ import annotations

import io
import json

import pytest
from rich.console import Console

from rn_eval.breakdown import breakdown
from rn_eval.evaluate import evaluate
from rn_eval.plan import Key, Variant
from rn_eval.pools import InProcess
from rn_eval.progress import label
from rn_eval.record import EpisodeOutcome, EpisodeRecord, MachineFacts
from rn_eval.report import load, write_report
from rn_eval.statistics import mcnemar, proportion, spread
from rn_eval.summary import summarise
from rn_eval.tables import paper_table
from roboneuron import ConfigurationError


def test_wilson_interval_of_published_examples():
    """Newcombe 1998, Statistics in Medicine 17:857, table I, method 3 (Wilson score without
    continuity correction).
    """
    published = {
        (81, 263): (0.2553, 0.3662),
        (15, 148): (0.0624, 0.1605),
        (0, 20): (0.0, 0.1611),
        (1, 29): (0.0061, 0.1718),
    }
    for (successes, trials), bounds in published.items():
        found = proportion(successes, trials)
        assert (round(found.low, 4), round(found.high, 4)) == bounds


def test_mcnemar_counts_only_pairs_that_differ():
    """Exact: 2 x P(X <= 1 | n = 9, 1/2) = 2 x 10 / 512."""
    first = {i: i < 20 for i in range(40)}
    # 8 lost, 1 won; five episodes have no partner
    second = {i: (i < 12) or i == 25 for i in range(45)}
    found = mcnemar(first, second)
    assert (found.pairs, found.only_first, found.only_second) == (40, 8, 1)
    assert found.p_value == pytest.approx(20 / 512)
    assert found.difference == pytest.approx(-7 / 40)
    assert mcnemar(first, first).p_value == 1.0


def test_without_data_there_are_no_numbers():
    assert str(proportion(0, 0)) == "-"
    assert spread([]).size == 0


def made_records():
    """LIBERO-like: two suites, two presets."""
    counts = {
        ("spatial", "none"): 9,
        ("spatial", "fastv-p75"): 8,
        ("goal", "none"): 7,
        ("goal", "fastv-p75"): 3,
    }
    records = []
    for (suite, preset), won in counts.items():
        for seed in range(10):
            key = Key(
                suite=suite, preset=preset, execution="sequential", latency="0", task="t", seed=seed
            )
            times = [900.0] + [60.0 if preset == "none" else 40.0] * 4
            outcome = EpisodeOutcome(
                status="success" if seed < won else "failure", metrics={"tokens_kept": 64.0}
            )
            records.append(
                EpisodeRecord(
                    key=key,
                    instruction="i",
                    outcome=outcome,
                    measured=MachineFacts(inference_ms=times, cold=1),
                )
            )
    return records


def test_the_papers_table_has_success_by_suite_and_speed_up():
    lines = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in paper_table(summarise(made_records())).splitlines()
    ]
    assert lines[0] == ["preset", "spatial %", "goal %", "mean %", "inference ms", "speed-up"]
    assert lines[2] == [
        "baseline",
        "90.0 [59.6, 98.2]",
        "70.0 [39.7, 89.2]",
        "80.0",
        "60.0",
        "1.00x",
    ]
    assert lines[3] == ["P75", "80.0 [49.0, 94.3]", "30.0 [10.8, 60.3]", "55.0", "40.0", "1.50x"]


def test_presets_are_compared_on_the_same_episodes():
    rows = summarise(made_records()).rows
    assert rows[0].paired is None
    assert rows[1].paired.only_first == 5
    assert rows[1].paired.only_second == 0
    assert rows[1].paired.p_value == pytest.approx(2 / 2**5)


def told(**facts_of_seed):
    """Episodes with facts: seeds 0, 1, ...; even ones succeed, odd ones also under the second
    preset.
    """
    names, values = list(facts_of_seed), list(zip(*facts_of_seed.values(), strict=True))
    records = []
    for preset in ("none", "fastv-p50"):
        for seed, told_of in enumerate(values):
            key = Key(
                suite="s", preset=preset, execution="sequential", latency="0", task="t", seed=seed
            )
            facts = {
                name: value for name, value in zip(names, told_of, strict=True) if value is not None
            }
            won = seed % 2 == 0 or preset != "none"
            records.append(
                EpisodeRecord(
                    key=key,
                    instruction="i",
                    outcome=EpisodeOutcome(status="success" if won else "failure", facts=facts),
                )
            )
    return summarise(records)


def lines_of(table):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]


def test_a_breakdown_counts_success_by_ranges_of_a_fact():
    """A bound belongs to the range above it; episodes without the fact have their own line."""
    summary = told(turned_rad=[0.5, 0.1, 0.2, 0.39, 0.4, None])
    lines = lines_of(breakdown(summary, "turned_rad=0.2,0.4"))
    assert lines[0] == ["turned_rad", "none", "fastv-p50"]
    assert [line[0] for line in lines[2:]] == ["below 0.2", "0.2 to 0.4", "from 0.4 on", "not told"]
    assert [line[1].split("(")[1] for line in lines[2:]] == ["0/1)", "1/2)", "2/2)", "0/1)"]
    assert [line[2].split("(")[1] for line in lines[2:]] == ["1/1)", "2/2)", "2/2)", "1/1)"]
    assert lines[3][1].startswith(str(proportion(1, 2)))


def test_a_breakdown_by_a_text_has_a_line_for_each_value():
    lines = lines_of(breakdown(told(target=["red", "blue", "red"]), "target"))
    assert [(line[0], line[1].split("(")[1]) for line in lines[2:]] == [
        ("blue", "0/1)"),
        ("red", "2/2)"),
    ]


@pytest.mark.parametrize(
    ("by", "message"),
    [
        ("weight", "the facts are target, turned_rad"),
        ("turned_rad=0.4,0.2", "rising"),
        ("turned_rad=nan", "rising"),
        ("target=0.1", "without bounds"),
    ],
)
def test_a_breakdown_that_cannot_be_made_is_refused(by, message):
    with pytest.raises(ConfigurationError, match=message):
        breakdown(told(target=["red"], turned_rad=[0.1]), by)


def test_variants_are_named_by_what_differs():
    modes = tuple(Variant("none", execution, "0") for execution in ("sequential", "overlap"))
    assert [label(v, modes) for v in modes] == ["sequential", "overlap"]
    assert label(modes[0], modes[:1]) == "none"
    both = (*modes, Variant("fastv-p50", "overlap", "0"))
    assert label(both[2], both) == "fastv-p50 overlap"


def test_reasons_that_differ_in_numbers_only_are_one_line():
    texts = [
        "The red cube was lifted by 0.2 cm.",
        "Time.",
        "The red cube was lifted by -3 cm.",
        "Row 7 is old.",
        "Time.",
        "Time.",
    ]
    records = [
        EpisodeRecord(
            key=Key(
                suite="s", preset="none", execution="sequential", latency="0", task="t", seed=seed
            ),
            instruction="i",
            outcome=EpisodeOutcome(status="failure", reason=text),
        )
        for seed, text in enumerate(texts)
    ]
    assert summarise(records).rows[0].reasons == (
        ("Time.", 3),
        ("The red cube was lifted by ... cm.", 2),
        ("Row 7 is old.", 1),
    )


def test_an_episode_of_two_ledgers_is_not_counted_twice(plan, tmp_path):
    made = plan(episodes=1)
    for name in ("a", "b"):
        evaluate(made, tmp_path / name, lambda: InProcess(made), Console(file=io.StringIO()))
    with pytest.raises(ConfigurationError, match=r"a and .*b both hold"):
        load([tmp_path / "a", tmp_path / "b"])


def test_the_report_is_one_file_and_agrees_with_the_ledger(plan, tmp_path):
    made = plan(episodes=4, latencies=("0", "250ms"))
    evaluate(made, tmp_path, lambda: InProcess(made), Console(file=io.StringIO()))
    summary = write_report([tmp_path], tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert page.count("<svg") == 2  # success by variant, against latency
    assert "data:image/png;base64," in page  # the strip of seed 3, which is unreachable
    assert 'src="http' not in page
    assert "href=" not in page.replace('xlink:href="#', "")
    data = json.loads((tmp_path / "report.json").read_text())
    assert [v["success"]["successes"] for v in data["variants"]] == [3, 3]
    assert summary.rows[0].success.trials == 4
    assert "75.0 % [30.1, 95.4]" in (tmp_path / "report.md").read_text()
    assert len((tmp_path / "episodes.csv").read_text().splitlines()) == 9
    assert load([tmp_path])[0].tasks == ("reach-0", "reach-1")


def test_text_of_a_policy_cannot_become_markup(plan, tmp_path):
    made = plan(episodes=1)
    evaluate(made, tmp_path, lambda: InProcess(made), Console(file=io.StringIO()))
    path = tmp_path / "episodes.jsonl"
    line = json.loads(path.read_text())
    line["outcome"].update(status="failure", reason="<script>alert(1)</script>")
    path.write_text(json.dumps(line) + "\n")
    write_report([tmp_path], tmp_path)
    assert "<script>" not in (tmp_path / "report.html").read_text()

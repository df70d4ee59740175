"""The same seed gives the same episode, regardless of earlier and concurrent episodes."""

from __future__ import annotations

import io

import numpy as np
import pytest
from rich.console import Console

from rn_eval.evaluate import evaluate
from rn_eval.latency import check_unit, median_s, parse_latency
from rn_eval.ledger import read_records
from rn_eval.pools import InProcess
from rn_eval.runner import Runner
from roboneuron import ConfigurationError
from roboneuron.plugins.discovery import discover


def outcomes(plan, jobs=None):
    runner = Runner(plan)
    jobs = jobs or list(
        plan.jobs(plan.build_suite(discover()).episodes(plan.episodes, plan.first_seed))
    )
    return {job.key: runner.run(job)[0].outcome for job in jobs}


def test_the_order_of_episodes_does_not_matter(plan):
    made = plan(latencies=("0", "lognormal:112ms,0.3"), executions=("sequential", "overlap"))
    jobs = list(made.jobs(made.build_suite(discover()).episodes(8, 0)))
    assert outcomes(made, jobs) == outcomes(made, jobs[::-1])


def test_more_episodes_begin_with_the_same_ones(plan):
    few, many = outcomes(plan(episodes=3)), outcomes(plan(episodes=6))
    assert few.items() <= many.items()


def test_latency_slows_sequential_episodes_more_than_overlapped_ones(plan):
    made = plan(latencies=("0", "250ms"), executions=("sequential", "overlap"), episodes=2)
    durations = {}
    for key, outcome in outcomes(made).items():
        durations.setdefault((key.execution, key.latency), []).append(outcome.duration_s)
    mean = {name: np.mean(values) for name, values in durations.items()}
    assert mean["sequential", "250ms"] > mean["sequential", "0"]
    assert mean["sequential", "250ms"] > mean["overlap", "250ms"]


def test_variants_meet_the_same_latencies(plan):
    """Common random numbers: the n-th prediction of a seed has the same latency under each preset
    and mode.
    """
    draws = [parse_latency("lognormal:112ms,0.3")(np.random.default_rng([3, 9])) for _ in range(2)]
    assert [draws[0](0.0) for _ in range(5)] == [draws[1](0.0) for _ in range(5)]


def test_a_policy_that_refuses_ends_its_episode_with_the_reason(plan, monkeypatch):
    made = plan(episodes=1, suite_options={})
    runner = Runner(made)
    job = next(iter(made.jobs(made.build_suite(discover()).episodes(1, 0))))
    policy = runner._policy_of("none")
    import toy_parts

    from roboneuron import UngroundedError

    def refuse(self, observation):
        raise UngroundedError("Nothing to see.")

    monkeypatch.setattr(toy_parts.Steer, "predict", refuse)
    monkeypatch.setattr("rn_eval.episode.PATIENCE_S", 0.5)
    outcome = runner.run(job)[0].outcome
    assert (outcome.status, outcome.reason) == ("failure", "The policy refused: Nothing to see.")
    assert outcome.duration_s < 1.0
    assert outcome.refusals == outcome.predictions > 3
    assert policy is runner._policy_of("none")


def test_a_crash_is_an_error_and_the_others_go_on(plan, tmp_path):
    made = plan(episodes=10, suite_options={"crashes": True})
    records = evaluate(made, tmp_path, lambda: InProcess(made), Console(file=io.StringIO()))
    by_seed = {record.key.seed: record for record in records}
    assert by_seed[7].outcome.status == "error"
    assert "the simulator crashed" in by_seed[7].outcome.reason
    assert [r.outcome.status for r in records].count("success") == 8
    assert by_seed[3].outcome.status == "failure"
    assert (tmp_path / "strips" / by_seed[3].strip).read_bytes().startswith(b"\x89PNG")
    again = evaluate(
        made, tmp_path, lambda: InProcess(made), Console(file=io.StringIO()), retry_errors=True
    )
    assert len(again) == 10
    assert len(read_records(tmp_path)) == 10
    assert len((tmp_path / "episodes.jsonl").read_text().splitlines()) == 11


@pytest.mark.parametrize(
    ("text", "median"),
    [
        ("0", 0.0),
        ("0.112", 0.112),
        ("112ms", 0.112),
        ("lognormal:112ms,0.2", 0.112),
        ("normal:0.1s,10ms", 0.1),
        ("measured", None),
    ],
)
def test_latencies_are_drawn_around_their_median(text, median):
    draw = parse_latency(text)(np.random.default_rng(0))
    drawn = np.median([draw(0.5) for _ in range(2001)])
    assert median_s(text) == median
    assert drawn == pytest.approx(0.5 if median is None else median, rel=0.02, abs=1e-12)


def test_latencies_are_drawn_from_a_file(tmp_path):
    path = tmp_path / "latencies.txt"
    path.write_text("0.1\n0.2\n")
    draw = parse_latency(f"file:{path}")(np.random.default_rng(0))
    assert {draw(0.0) for _ in range(50)} == {0.1, 0.2}


@pytest.mark.parametrize(
    "text", ["fast", "-1", "lognormal:112ms", "file:/no/such/file", "uniform:1,2"]
)
def test_a_latency_that_is_not_understood_is_refused(text):
    with pytest.raises(ConfigurationError):
        parse_latency(text)


@pytest.mark.parametrize(
    "text", ["112", "0.112", "normal:112,10ms", "normal:112ms,10", "lognormal:112,0.2"]
)
def test_a_latency_without_a_unit_is_refused_on_the_command_line(text):
    with pytest.raises(ConfigurationError, match="has no unit") as refusal:
        check_unit(text)
    assert "ms or " in refusal.value.hint


def test_a_deviation_of_a_logarithm_has_no_unit():
    with pytest.raises(ConfigurationError, match="has a unit"):
        check_unit("lognormal:112ms,0.2ms")


@pytest.mark.parametrize(
    "text",
    [
        "0",
        "0.0",
        "112ms",
        "0.112s",
        "normal:112ms,0",
        "normal:0.1s,10ms",
        "lognormal:112ms,0.2",
        "measured",
    ],
)
def test_a_latency_with_its_unit_passes(text):
    check_unit(text)


def test_the_command_refuses_it_before_it_makes_anything(toy, tmp_path):
    from argparse import ArgumentParser

    from rn_eval.command import Eval

    parser = ArgumentParser()
    Eval().configure(parser)
    words = [
        "run",
        "--suite",
        "toy",
        "--backend",
        "steer",
        "--latency",
        "112",
        "--out",
        str(tmp_path / "out"),
    ]
    with pytest.raises(ConfigurationError, match="--latency 112: 112 has no unit"):
        Eval().run(parser.parse_args(words))
    assert not (tmp_path / "out").exists()

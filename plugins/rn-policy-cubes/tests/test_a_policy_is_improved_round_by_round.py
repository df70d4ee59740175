"""`policy cubes improve`: rounds with the same result even if killed, promotion only of policies
that are not worse, and rollback.
"""

from __future__ import annotations

import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from rn_policy_cubes import improving
from rn_policy_cubes.demonstrations import COLOURS, shard_files
from rn_policy_cubes.improvement_ledger import (
    LEDGER_FILE,
    ImprovementLedger,
    alone_in,
)
from rn_policy_cubes.improving import RoundPlan, Wheel, evaluation_seed, recipe_of_round
from rn_policy_cubes.network import CubesNetwork
from rn_policy_cubes.packing import Card, Packed
from rn_policy_cubes.recipe import Recipe
from rn_policy_cubes.rollouts import Student, write_rollouts
from rn_policy_cubes.words import write_tokenizer
from roboneuron import ConfigurationError, PluginError, StateError

pytest.importorskip("rn_eval")

SETTINGS = {"views": 3, "tokens": 20, "full_views": 2}


class Killed(Exception):
    """Simulates the end of the process."""


@pytest.fixture
def weights(network: CubesNetwork, recipe: Recipe, tmp_path: Path) -> Path:
    """A random network as the first champion."""
    path = tmp_path / "first.safetensors"
    Packed.of(network, Card(recipe=recipe, step=0, cpu_s=0.0)).write(path)
    return path


@pytest.fixture
def plan() -> RoundPlan:
    """A round that takes seconds."""
    recipe = recipe_of_round(2, 4, SETTINGS)
    return RoundPlan(recipe=recipe, rollouts=1, views=10, seeds=6, time_limit_s=1.0)


@pytest.fixture
def judged(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """Seeds solved by each champion and each challenger in turn, instead of an evaluation."""
    solved: list[tuple[int, ...]] = [(0, 1, 2), (0, 1, 2, 3)] * 4
    turns = iter(range(len(solved)))

    def evaluate(
        checkpoint: Path,
        out: Path,
        *,
        first_seed: int,
        count: int,
        time_limit_s: float,
        suite_options: Sequence[str],
    ) -> dict[int, bool]:
        assert (checkpoint / "config.json").exists()
        chosen = solved[next(turns)]
        return {first_seed + number: number in chosen for number in range(count)}

    monkeypatch.setattr(improving, "evaluate", evaluate)
    return solved


@pytest.fixture
def untrained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounds whose challenger is the champion: for tests of what follows the training."""

    def copied(self: Wheel, number: int, plan: RoundPlan, champion: int) -> None:
        self._weights(number).parent.mkdir(parents=True)
        shutil.copyfile(self._weights(champion), self._weights(number))
        self.ledger.add(number, "trained", {})

    monkeypatch.setattr(Wheel, "_train", copied)


def quiet(line: str) -> None:
    """Print nothing."""


def turn(directory: Path, weights: Path, plan: RoundPlan) -> Wheel:
    """Run one round, or the rest of it."""
    wheel = Wheel(directory, quiet)
    wheel.run(wheel.begin(weights, plan, []))
    return wheel


@pytest.mark.exhaustive
def test_a_better_challenger_is_promoted_and_rolled_back(
    judged: list[tuple[int, ...]], weights: Path, plan: RoundPlan, tmp_path: Path
) -> None:
    wheel = turn(tmp_path / "out", weights, plan)
    assert wheel.champion == 1
    words = [entry["what"] for entry in wheel.ledger.entries]
    assert words == ["begun", "rolled_out", "trained", "evaluated", "promoted"]
    test = wheel.ledger.entries[3]["test"]
    assert (test["champion"], test["challenger"], test["only_challenger"]) == (3, 4, 1)
    settings = (wheel.checkpoint(1) / "roboneuron.toml").read_text()
    assert f'checkpoint = "{wheel.checkpoint(1)}"' in settings
    again = Wheel(tmp_path / "out", quiet)
    assert again.roll_back() == (1, 0)
    assert Wheel(tmp_path / "out", quiet).champion == 0
    with pytest.raises(StateError, match="is the first one"):
        again.roll_back()


@pytest.mark.exhaustive
@pytest.mark.usefixtures("untrained")
def test_a_worse_challenger_is_not_promoted_but_what_it_learnt_from_is_kept(
    judged: list[tuple[int, ...]], weights: Path, plan: RoundPlan, tmp_path: Path
) -> None:
    judged[1] = (0, 1)
    wheel = turn(tmp_path / "out", weights, plan)
    assert wheel.champion == 0
    assert wheel.ledger.entries[-1]["what"] == "kept"
    wheel = turn(tmp_path / "out", weights, plan)
    assert wheel.champion == 2
    assert wheel.ledger.of(2, "begun")["champion"] == 0
    for number in (10_000, 20_000):
        rows, _ = shard_files(tmp_path / "out" / "demonstrations", number)
        assert len(np.load(rows)) == plan.views


@pytest.mark.usefixtures("untrained")
@pytest.mark.parametrize(
    ("ordinary", "elsewhere", "margin", "is_promoted"),
    [
        (((0, 1), (0, 1)), ((0,), (0, 1)), 0.0, True),
        (((0, 1), (0,)), ((0,), (0, 1, 2)), 0.0, False),
        (((0, 1), (0,)), ((0,), (0, 1, 2)), 0.2, True),
        (((0,), (0, 1)), ((0, 1), (0,)), 0.0, False),
    ],
)
def test_a_policy_is_promoted_if_it_is_worse_neither_on_ordinary_scenes_nor_elsewhere(
    judged: list[tuple[int, ...]],
    weights: Path,
    plan: RoundPlan,
    tmp_path: Path,
    ordinary: tuple[tuple[int, ...], ...],
    elsewhere: tuple[tuple[int, ...], ...],
    margin: float,
    is_promoted: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = plan.model_copy(update={"suite_options": ("shift=light",), "margin": margin})
    monkeypatch.setattr(improving, "record", lambda *where, **what: None)
    monkeypatch.setattr(Wheel, "_roll_out", lambda *round_: None)
    # the champion elsewhere comes first, so that a wrong option fails before the training
    judged[:5] = [elsewhere[0], *ordinary, *elsewhere]
    wheel = turn(tmp_path / "out", weights, plan)
    assert (wheel.champion == 1) is is_promoted
    evaluated = wheel.ledger.of(1, "evaluated")
    assert evaluated is not None
    found = [
        (evaluated[name]["champion"], evaluated[name]["challenger"])
        for name in ("test", "test_elsewhere")
    ]
    assert found == [tuple(map(len, ordinary)), tuple(map(len, elsewhere))]


def test_an_option_that_the_suite_does_not_have_fails_before_the_training(
    weights: Path, plan: RoundPlan, tmp_path: Path
) -> None:
    plan = plan.model_copy(update={"suite_options": ("no=1",)})
    with pytest.raises(PluginError, match="scenes have no verdict"):
        turn(tmp_path / "out", weights, plan)
    assert [entry["what"] for entry in ImprovementLedger(tmp_path / "out").entries] == ["begun"]


@pytest.mark.parametrize(
    "what",
    [
        pytest.param("trained", marks=pytest.mark.exhaustive),
        *(
            pytest.param(word, marks=pytest.mark.slow)
            for word in ("begun", "rolled_out", "evaluated", "promoted")
        ),
    ],
)
def test_a_round_that_was_ended_anywhere_ends_as_one_that_was_not(
    judged: list[tuple[int, ...]],
    weights: Path,
    plan: RoundPlan,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    what: str,
) -> None:
    whole = turn(tmp_path / "whole", weights, plan)
    judged[2:4] = judged[:2]
    add = ImprovementLedger.add

    def add_or_die(self: ImprovementLedger, number: int, word: str, facts: object) -> None:
        if word == what:
            raise Killed
        add(self, number, word, facts)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(ImprovementLedger, "add", add_or_die)
        with pytest.raises(Killed):
            turn(tmp_path / "parts", weights, plan)
    judged[4:6] = judged[:2]
    ended = turn(tmp_path / "parts", weights, plan)
    assert ended.champion == whole.champion == 1
    assert [e["what"] for e in ended.ledger.entries] == [e["what"] for e in whole.ledger.entries]
    same(tmp_path / "whole", tmp_path / "parts")


def same(first: Path, second: Path) -> None:
    """Check that both have the same challenger, bit for bit."""
    one, other = (
        Packed.read(path / "rounds" / "0001" / "weights.safetensors") for path in (first, second)
    )
    for name, tensor in one.tensors.items():
        assert torch.equal(tensor, other.tensors[name]), name


def test_a_round_under_way_is_ended_by_its_own_plan(
    judged: list[tuple[int, ...]], weights: Path, plan: RoundPlan, tmp_path: Path
) -> None:
    wheel = Wheel(tmp_path / "out", quiet)
    wheel.begin(weights, plan, [])
    with pytest.raises(StateError, match=r"Round 1 .* has another plan"):
        wheel.begin(weights, plan.model_copy(update={"seeds": 7}), [])
    with pytest.raises(StateError, match="Round 1 is unfinished"):
        wheel.roll_back()
    held = alone_in(tmp_path / "out")
    with (
        held,
        pytest.raises(StateError, match="Another process"),
        alone_in(tmp_path / "out"),
    ):
        pass


def test_a_line_that_was_cut_short_has_not_happened(tmp_path: Path) -> None:
    ledger = ImprovementLedger(tmp_path)
    ledger.add(1, "begun", {"champion": 0})
    with (tmp_path / LEDGER_FILE).open("ab") as file:
        file.write(b'{"round": 1, "what": "promo')
    again = ImprovementLedger(tmp_path)
    assert (again.champions, again.unfinished) == ([0], 1)
    again.add(1, "promoted", {})
    assert ImprovementLedger(tmp_path).champions == [0, 1]
    (tmp_path / LEDGER_FILE).write_bytes(b"no ledger\n")
    with pytest.raises(StateError, match="is no ledger"):
        ImprovementLedger(tmp_path)


def test_no_round_is_judged_by_scenes_that_were_trained_on() -> None:
    assert evaluation_seed(2) >= evaluation_seed(1) + RoundPlan.model_fields["seeds"].metadata[1].le
    with pytest.raises(ConfigurationError, match="no unseen scenes"):
        evaluation_seed(900)


def test_rollouts_are_made_again_alike_and_are_labelled_for_every_colour(
    weights: Path, tmp_path: Path
) -> None:
    tokenizer = tmp_path / "tokenizer.json"
    write_tokenizer(tokenizer)
    student = Student(Packed.read(weights), tokenizer)
    for name in ("one", "two"):
        write_rollouts(tmp_path / name, 10_000, 8, student)
    for one, two in zip(
        shard_files(tmp_path / "one", 10_000), shard_files(tmp_path / "two", 10_000), strict=True
    ):
        assert np.array_equal(np.load(one), np.load(two))
    rows = np.load(shard_files(tmp_path / "one", 10_000)[0])
    assert (rows["seed"] >= 11_000_000).all()
    assert set(rows["target"]) <= set(range(len(COLOURS)))
    # the student moves the arm: a new network moves differently from the teacher
    assert np.ptp(rows["tcp_m"], axis=0).max() > 0.005


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_round_that_is_killed_at_any_time_ends_as_one_that_is_not(
    weights: Path, tmp_path: Path
) -> None:
    words = [sys.executable, "-P", "-m", "roboneuron.cli.main", "policy", "cubes", "improve"]
    words += ["--weights", str(weights), "--shards", "2", "--rollouts", "1", "--views", "10"]
    words += ["--steps", "4", "--seeds", "2", "--max-s", "1"]
    words += [f"--set={name}={value}" for name, value in SETTINGS.items()]

    def begin(name: str) -> subprocess.Popen[bytes]:
        out = ["--out", str(tmp_path / name)]
        return subprocess.Popen([*words, *out], stdout=subprocess.DEVNULL)

    assert begin("whole").wait() == 0
    draw, kills = random.Random(1), 0
    for _ in range(100):
        process = begin("parts")
        try:
            status = process.wait(draw.uniform(3.0, 3.0 + 2.0 * kills))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            kills += 1
            continue
        assert status == 0
        break
    assert kills > 1
    same(tmp_path / "whole", tmp_path / "parts")
    entries = [
        [entry["what"] for entry in ImprovementLedger(tmp_path / name).entries]
        for name in ("whole", "parts")
    ]
    assert entries[0] == entries[1]

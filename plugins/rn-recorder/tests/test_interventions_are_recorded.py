"""What a person did while leading becomes the action of its rows; spans are cut, runs are
labelled.
"""

from __future__ import annotations

import json
from argparse import ArgumentParser
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from recorder_demonstrations import action, record_run, store_in

from rn_recorder_policy.lerobot_reading import episode_count, read_lerobot
from rn_recorder_runs.acted import BLEND, NOBODY, PERSON, POLICY, ActedRow, Deeds, composed
from rn_recorder_runs.command import Runs
from rn_recorder_runs.lerobot import export
from rn_recorder_runs.store import RUN_FILE, Run, RunStore
from rn_standard.teleoperation.rows import Acting
from roboneuron import EE_DELTA, InvalidInputError, StateError, matrix_from_rotvec

PERIOD_NS = 100_000_000
LED = {
    1: "policy",
    2: Acting(who="person", session="one", number=1, moved=(0.01, 0, 0, 0, 0, 0.1)),
    3: Acting(who="person", session="one", number=2, moved=(0, 0.02, 0, 0, 0, 0), gripper_open=0.7),
    4: Acting(who="blend", session="one", number=3, moved=(0.0, 0, -0.005, 0, 0, 0)),
    5: "nobody",
    6: Acting(who="person", session="two", number=1, moved=(0.03, 0, 0, 0, 0, 0)),
}


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    return store_in(tmp_path)


@pytest.fixture
def run(store: RunStore) -> Run:
    """One episode of eight rows, in which a person acts three times."""
    return record_run(store, "demo", [("pick up the cup", "failure")], acting=LED)


def call(store: RunStore, *words: str) -> int:
    parser = ArgumentParser()
    Runs().configure(parser)
    return Runs().run(parser.parse_args(["--directory", str(store.directory), *words]))


def table_of(directory: Path) -> dict[str, list[object]]:
    found = pq.read_table(directory / "data/chunk-000/file-000.parquet").to_pydict()
    return dict(found)


def test_the_action_of_a_row_is_what_was_executed(run: Run, tmp_path: Path) -> None:
    export([run], tmp_path / "set", outcome=None, fps=None, codec="h264")
    table = table_of(tmp_path / "set")
    policy = [action(number) for number in range(8)]
    np.testing.assert_array_equal(table["roboneuron.policy_action"], policy)
    expected = list(policy)
    expected[2] = np.array([0.01, 0, 0, 0, 0, 0.1, 1 / 3])  # the opening that the policy had asked
    expected[3] = np.array([0, 0.02, 0, 0, 0, 0, 0.7])
    expected[4] = np.array([0, 0, -0.005, 0, 0, 0, 1 / 3])  # and asks for beside the person
    expected[5] = np.array([0, 0, 0, 0, 0, 0, 1 / 3])
    expected[6] = np.array([0.03, 0, 0, 0, 0, 0, 1 / 3])
    np.testing.assert_allclose(table["roboneuron.action"], expected, atol=1e-15)
    np.testing.assert_array_equal(table["action"], np.float32(table["roboneuron.action"]))
    assert table["roboneuron.who"] == [0, 0, 1, 1, 2, 3, 1, 0]
    assert table["intervention"] == [False, False, True, True, True, False, True, False]


def test_who_reads_the_data_set_sees_who_acted(run: Run, tmp_path: Path) -> None:
    export([run], tmp_path / "set", outcome=None, fps=None, codec="h264")
    assert episode_count(tmp_path / "set") == 1
    read = read_lerobot(tmp_path / "set", 0).columns
    assert read["intervention"].values[:, 0].tolist() == [0, 0, 1, 1, 1, 0, 1, 0]
    assert read["action"].values[3, :2] == pytest.approx([0, 0.02])


def test_what_a_person_did_adds_up_to_the_whole_motion() -> None:
    random = np.random.default_rng(3)
    rows = [ActedRow(20 * (n + 1), PERSON, random.normal(0, 0.02, 6)) for n in range(50)]
    deeds = Deeds(rows)
    shadow = np.full(7, 9.0)
    found = [deeds.next(shadow, EE_DELTA.label, at, at + 100) for at in range(0, 1000, 100)]
    assert [deed.who for deed in found] == [PERSON] * 10
    whole = composed([row.moved for row in rows])
    np.testing.assert_allclose(composed([deed.action[:6] for deed in found]), whole, atol=1e-12)
    turn = np.eye(3)
    for row in rows:
        turn = matrix_from_rotvec(row.moved[3:]) @ turn
    np.testing.assert_allclose(matrix_from_rotvec(whole[3:]), turn, atol=1e-12)


def test_what_is_told_late_belongs_to_another_action() -> None:
    deeds = Deeds([ActedRow(400_000_000, PERSON, np.zeros(6))])
    assert deeds.next(np.zeros(7), EE_DELTA.label, 0, PERIOD_NS).who == POLICY


@pytest.mark.parametrize("who", [PERSON, BLEND, NOBODY])
def test_what_is_not_told_in_the_policys_space_is_not_made_up(who: str) -> None:
    acted = [ActedRow(1, who, np.zeros(0))]
    assert Deeds(acted).next(np.zeros(3), "joint_position:a,b,c", 0, 10).action.size == 0
    delta = Deeds(acted).next(np.zeros(7), EE_DELTA.label, 0, 10)
    assert delta.action.size == (7 if who == NOBODY else 0)


def test_an_episode_whose_person_is_not_told_is_left_out_by_name(
    store: RunStore, tmp_path: Path
) -> None:
    run = record_run(store, "old", [("a", "success"), ("b", "success")], acting={3: "person"})
    written = export([run], tmp_path / "set", outcome=None, fps=None, codec="h264")
    assert written.episodes == 1
    assert "what a person did is not recorded as ee_delta_base in 1 of its 8 rows" in str(
        written.skipped[0]
    )


def test_spans_are_listed_and_cut(
    store: RunStore, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(store, "interventions", run.id, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert [(one["first"], one["rows"], one["who"]) for one in found] == [
        (2, 3, "person,blend"),
        (6, 1, "person"),
    ]
    assert found[0]["duration_s"] == pytest.approx(0.2)
    words = ["export", run.id, "--lerobot", str(tmp_path / "set"), "--codec", "h264"]
    assert call(store, *words, "--interventions") == 0
    table = table_of(tmp_path / "set")
    assert table["episode_index"] == [0, 0, 0, 1]
    assert all(table["intervention"])
    record_run(store, "zero", [("pick up the cup", "failure")])
    with pytest.raises(InvalidInputError, match="No intervention in these runs"):
        call(store, "export", "zero", "--lerobot", str(tmp_path / "none"), "--interventions")
    with pytest.raises(InvalidInputError, match="cuts a data set"):
        call(store, "export", run.id, "--mcap", str(tmp_path / "none"), "--interventions")


def test_a_label_counts_more_than_what_was_told(
    store: RunStore, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = record_run(store, "two", [("a", "failure"), ("b", "failure")])
    call(store, "label", run.id, "--outcome", "unknown", "--comment", "camera moved")
    call(store, "label", run.id, "--episode", "1", "--outcome", "success")
    capsys.readouterr()
    call(store, "list", "--json")
    listed = json.loads(capsys.readouterr().out)
    assert (listed[0]["outcome"], listed[0]["note"]) == ("unknown", "camera moved")
    export([store.get("two")], tmp_path / "set", outcome="success", fps=None, codec="h264")
    origin = json.loads((tmp_path / "set/meta/roboneuron.json").read_text())
    assert [(e["instruction"], e["outcome"], e["comment"]) for e in origin["episodes"]] == [
        ("b", "success", "camera moved")
    ]


def test_a_label_that_cannot_be_kept_is_refused(
    store: RunStore, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InvalidInputError, match="nothing to note"):
        call(store, "label", run.id)
    with pytest.raises(InvalidInputError, match="has no episode 1"):
        call(store, "label", run.id, "--episode", "1", "--outcome", "success")
    facts = store.recordings / run.id / RUN_FILE
    facts.write_text(json.dumps({"state": "recording"}))
    monkeypatch.setattr(RunStore, "is_in_use", lambda self: True)
    with pytest.raises(StateError, match="is being recorded"):
        call(store, "label", run.id, "--outcome", "success")

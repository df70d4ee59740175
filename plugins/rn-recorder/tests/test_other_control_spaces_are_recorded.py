"""Actions of other control spaces than TCP displacements: described, exported and replayed by the
names of their channels.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from policy_runs import write_run
from policy_world import RATE_HZ, ROWS, SPACES, KnowingPolicy, arm_profile, recorded
from rclpy.serialization import serialize_message
from std_msgs.msg import Float64MultiArray

from rn_recorder.playing import check_playable
from rn_recorder_runs.action_labels import label_of
from rn_recorder_runs.comparison import compare, describe, write_report
from rn_recorder_runs.episodes import read_episodes, read_streams
from rn_recorder_runs.files import Record, RunFile, copy_records, read_records
from rn_recorder_runs.lerobot import export
from rn_recorder_runs.observations import Observations
from rn_recorder_runs.replay import EXACT, Compared, replay
from rn_recorder_runs.replayed_run import check_labels
from rn_recorder_runs.store import Run
from roboneuron import ACTION_LABEL, ControlSpace, InvalidInputError
from roboneuron.modules.inference.agreement import SpaceAgreement
from roboneuron.ros.messages import to_action_message

KINDS = ("joint_position", "joint_velocity")


def run_of(folder: Path) -> Run:
    """The run in a folder."""
    return Run(
        id=folder.name, kind="recording", files=tuple(sorted(folder.glob("*.mcap"))), facts={}
    )


def unchanged(space: ControlSpace) -> SpaceAgreement:
    """Rows go to control as they are."""
    return SpaceAgreement(declared=space, executed=space, columns=tuple(range(space.size)))


def observations(folder: Path) -> Observations:
    """Those of the run in a folder."""
    profile = arm_profile()
    return Observations(run_of(folder).files, {"primary": profile.cameras[0]}, frozenset(), profile)


def replayed(folder: Path, kind: str, policy: KnowingPolicy) -> list[Compared]:
    """Every prediction of the run, asked again."""
    return list(replay(observations(folder), policy, unchanged(SPACES[kind])))


def mixed(folder: Path) -> Path:
    """A run whose second half has actions of another space."""
    first, second = (write_run(folder.with_name(f"{folder.name}-{kind}"), kind) for kind in KINDS)
    folder.mkdir()
    file = RunFile(folder / "part-0001.mcap", {"robot": "toy"})
    parts = (read_records(path / "part-0001.mcap") for path in (first, second))
    for before, after in zip(*parts, strict=True):
        file.write(before if before.sequence <= ROWS // 2 else after)
    file.finish()
    return folder


@pytest.mark.parametrize("kind", SPACES)
def test_a_serialized_action_names_its_space(kind: str) -> None:
    space = SPACES[kind]
    message = bytes(serialize_message(to_action_message(np.zeros(space.size), space)))
    assert label_of(message) == space.label
    assert label_of(message[:14]) == ""
    assert label_of(b"") == ""


def test_an_action_without_a_layout_is_a_displacement() -> None:
    message = bytes(serialize_message(Float64MultiArray(data=[0.0] * 7)))
    assert label_of(message) == ACTION_LABEL


@pytest.mark.parametrize("kind", SPACES)
def test_channels_name_the_values_by_the_label(tmp_path: Path, kind: str) -> None:
    path = write_run(tmp_path / kind, kind) / "part-0001.mcap"
    copy = tmp_path / "copy.mcap"
    copy_records([path], copy, {})
    expected = " ".join(f"data[{at}]={key}" for at, key in enumerate(SPACES[kind].keys))
    for file in (path, copy):
        with file.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        (told,) = [c.metadata for c in summary.channels.values() if c.topic.endswith("/action")]
        assert told["roboneuron.fields"] == expected
        assert told["roboneuron.space"] == SPACES[kind].label


def test_a_change_of_space_begins_another_channel(tmp_path: Path) -> None:
    path = mixed(tmp_path / "mixed") / "part-0001.mcap"
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    found = [c.metadata["roboneuron.space"] for c in summary.channels.values() if c.metadata]
    assert sorted(found) == sorted(SPACES[kind].label for kind in KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_a_data_set_names_the_channels(tmp_path: Path, kind: str) -> None:
    folder = write_run(tmp_path / kind, kind)
    written = export([run_of(folder)], tmp_path / "set", outcome=None, fps=None, codec="h264")
    assert (written.episodes, written.frames, written.skipped) == (1, ROWS, ())
    features = json.loads((tmp_path / "set/meta/info.json").read_text())["features"]
    for name in ("action", "roboneuron.action"):
        assert features[name]["names"] == list(SPACES[kind].keys)
        assert features[name]["shape"] == [8]
    table = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")
    np.testing.assert_array_equal(table.column("roboneuron.action").to_pylist(), recorded(kind))
    origin = json.loads((tmp_path / "set/meta/roboneuron.json").read_text())
    assert origin["action_space"] == SPACES[kind].label


def test_episodes_of_different_spaces_are_not_put_into_one_data_set(tmp_path: Path) -> None:
    runs = [run_of(write_run(tmp_path / kind, kind)) for kind in KINDS]
    mixture = run_of(mixed(tmp_path / "mixed"))
    written = export([*runs, mixture], tmp_path / "set", outcome=None, fps=None, codec="h264")
    assert written.episodes == 1
    why = {left.run: left.why for left in written.skipped}
    assert "it has other control spaces (joint_velocity@10:joint1," in why["joint_velocity"]
    assert "change from one control space to another (joint_position:joint1," in why["mixed"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_replay_compares_whole_rows_by_name(tmp_path: Path, kind: str) -> None:
    folder = write_run(tmp_path / kind, kind)
    same = replayed(folder, kind, KnowingPolicy(kind, noise=0.0, horizon=1))
    comparison = compare(same, EXACT)
    assert (comparison.predictions, comparison.diverging) == (ROWS, 0)

    def wrong(asked) -> np.ndarray:
        rows = asked.rows()
        rows[:, 5] += 0.25 * (asked.row >= 10)
        return rows

    found = replayed(folder, kind, KnowingPolicy(kind, wrong, noise=0.0, horizon=1))
    comparison = compare(found, EXACT)
    assert comparison.first == 10
    text = describe(comparison, found)
    assert "Row 0, joint6:" in text
    assert f"{'gripper_open':<12} {0.0:>12.3e}" in text
    write_report(tmp_path / "out", found, comparison)
    told = json.loads((tmp_path / "out/comparison.json").read_text())
    assert told["largest"]["joint6"] == pytest.approx(0.25)
    assert list(told["largest"]) == list(SPACES[kind].keys)


def test_answers_of_another_space_are_not_compared(tmp_path: Path) -> None:
    found = observations(write_run(tmp_path / "velocity", "joint_velocity"))
    check_labels(found, unchanged(SPACES["joint_velocity"]))
    with pytest.raises(InvalidInputError, match=r"'joint_velocity@10:.*backend's are of 'joint_po"):
        check_labels(found, unchanged(SPACES["joint_position"]))
    other = replace(SPACES["joint_velocity"], rate_hz=2 * RATE_HZ)
    with pytest.raises(InvalidInputError, match="joint_velocity@20"):
        check_labels(found, unchanged(other))
    both = observations(mixed(tmp_path / "mixed"))
    assert len(both.labels) == 2
    with pytest.raises(InvalidInputError, match="joint_velocity"):
        check_labels(both, unchanged(SPACES["joint_position"]))


def test_only_displacements_are_played_into_a_simulation(tmp_path: Path) -> None:
    check_playable(read_streams(run_of(write_run(tmp_path / "delta", "ee_delta")).files))
    streams = read_streams(run_of(write_run(tmp_path / "position", "joint_position")).files)
    with pytest.raises(InvalidInputError, match=r"actions of joint_position:joint1,.*only TCP"):
        check_playable(streams)


def test_rows_that_do_not_fit_their_label_are_left_out(tmp_path: Path) -> None:
    """Control refuses them as well."""
    folder = write_run(tmp_path / "run", "joint_position")
    path = tmp_path / "bad.mcap"
    file = RunFile(path, {})
    short = to_action_message(np.zeros(8), SPACES["joint_position"])
    short.data = short.data[:5]
    for record in read_records(folder / "part-0001.mcap"):
        file.write(record)
        if record.topic.endswith("/action"):
            at_ns = record.log_ns + 1
            data = bytes(serialize_message(short))
            file.write(Record(record.topic, record.type, at_ns, at_ns, 0, data))
    file.finish()
    (episode,), _ = read_episodes("bad", [path], {})
    assert len(episode.rows) == ROWS
    assert episode.labels == (SPACES["joint_position"].label,)

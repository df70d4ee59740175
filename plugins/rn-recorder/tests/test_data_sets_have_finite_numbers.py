"""A number that is not finite comes into no data set: its episode is left out, by name."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from recorder_demonstrations import record_run, rewritten, store_in
from std_msgs.msg import Float64MultiArray, String

from rn_recorder_runs.data_sets import DataSetEpisode, DataSetFormat, write_data_set
from rn_recorder_runs.files import Record, RunFile, read_records
from rn_recorder_runs.images import to_string
from rn_recorder_runs.lerobot import export
from rn_recorder_runs.lerobot_meta import vector
from rn_recorder_runs.store import Run
from roboneuron import StateError

TWO = [("pick up the cup", "success"), ("put it down", "failure")]


def told(number: int, change: Callable[[Any], object]) -> Callable[[Record], Record | None]:
    """Change message `number` of the topic `action`, or of `predictions` if it is a dict."""
    seen = {"action": -1, "predictions": -1}

    def changed(record: Record) -> Record:
        topic = record.topic.rpartition("/")[2]
        if topic not in seen:
            return record
        seen[topic] += 1
        if seen[topic] != number:
            return record
        if topic == "action":
            message = deserialize_message(record.data, Float64MultiArray)
            change(message.data)
            return replace(record, data=bytes(serialize_message(message)))
        facts = json.loads(deserialize_message(record.data, String).data)
        change(facts)
        return replace(record, data=to_string(json.dumps(facts)))

    return changed


def action_is(value: float) -> Callable[[Any], object]:
    def change(found: Any) -> None:
        if not isinstance(found, dict):
            found[3] = value

    return change


def state_is(part: str, key: str, value: float) -> Callable[[Any], object]:
    def change(found: Any) -> None:
        if isinstance(found, dict):
            found[part][key][1] = value

    return change


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (action_is(math.nan), "its action"),
        (action_is(-math.inf), "its action"),
        (action_is(1e308), "its action"),
        (state_is("joints", "position", math.nan), "its joint state"),
        (state_is("ee_pose", "position_m", -1e39), "its TCP pose"),
    ],
    ids=["nan", "infinite", "too large for float32", "joints", "pose"],
)
def test_a_number_that_is_not_finite_leaves_out_its_episode_only(
    tmp_path: Path, change: Callable[[Any], object], what: str
) -> None:
    made = record_run(store_in(tmp_path), "made", TWO)
    foreign = rewritten(made, "foreign", told(11, change))
    written = export([made, foreign], tmp_path / "set", outcome=None, fps=None, codec="h264")
    assert (written.episodes, written.frames) == (3, 24)
    (left,) = written.skipped
    assert (left.run, left.instruction) == ("foreign", "put it down")
    assert left.why == f"{what} at 0.30 s is not finite or too large for float32"
    stats = (tmp_path / "set/meta/stats.json").read_text()
    json.loads(stats, parse_constant=pytest.fail)


def test_a_limit_that_is_infinite_is_told_as_text(tmp_path: Path) -> None:
    run = record_run(store_in(tmp_path), "demo", TWO)
    folder = tmp_path / "other"
    folder.mkdir()
    about = {"robot": "toy", "config": json.dumps({"limits": {"step_m": math.inf}})}
    file = RunFile(folder / "part-0001.mcap", about)
    for record in read_records(run.files[0]):
        file.write(record)
    file.finish()
    other = Run(id="other", kind="recording", files=(folder / "part-0001.mcap",), facts={})
    export([other], tmp_path / "set", outcome=None, fps=None, codec="h264")
    text = (tmp_path / "set/meta/roboneuron.json").read_text()
    origin = json.loads(text, parse_constant=pytest.fail)
    assert origin["config"] == {"limits": {"step_m": "Infinity"}}


def test_no_file_of_a_data_set_has_a_number_that_json_lacks(tmp_path: Path) -> None:
    form = DataSetFormat({"action": vector("float32", ["x"])}, 10, "h264", None)
    rows = [np.zeros(1, np.float32)] * 2
    episode = DataSetEpisode("wave", 2, {"action": rows}, iter([{}, {}]))
    with pytest.raises(StateError, match=r"roboneuron\.json would contain a number"):
        write_data_set(tmp_path / "set", form, [episode], {"mean": math.nan})
    assert not (tmp_path / "set/meta/roboneuron.json").exists()

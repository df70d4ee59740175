"""`roboneuron runs`: what it prints and does, on recorded demonstrations."""

from __future__ import annotations

import io
import json
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from recorder_demonstrations import record_run, store_in

from rn_recorder_runs.command import Runs
from rn_recorder_runs.files import RunFile, is_finished, read_records
from rn_recorder_runs.store import RunStore
from roboneuron import ConfigurationError, InvalidInputError

Call = Callable[..., Any]


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    """Two runs, one of two episodes."""
    store = store_in(tmp_path)
    record_run(store, "monday", [("pick it up", "success"), ("put it down", "failure")])
    record_run(store, "tuesday", [("pick it up", "success")])
    return store


@pytest.fixture
def runs(store: RunStore, capsys: pytest.CaptureFixture[str]) -> Call:
    """Return a function that runs the command, and gives what it prints; JSON is read."""

    def call(*words: str) -> Any:
        parser = ArgumentParser()
        command = Runs()
        command.configure(parser)
        assert command.run(parser.parse_args(["--directory", str(store.directory), *words])) == 0
        text = capsys.readouterr().out
        return json.loads(text) if "--json" in words else text

    return call


def test_runs_are_listed_with_length_and_messages(runs: Call) -> None:
    monday, tuesday = runs("list", "--json")
    assert (monday["id"], monday["kind"], monday["complete"]) == ("monday", "recording", True)
    assert monday["messages"] == 2 * tuesday["messages"] == 2 * (8 * 6 + 1)
    assert monday["duration_s"] == pytest.approx(1.6, abs=0.1)
    lines = runs("list").splitlines()
    assert [line.split()[0] for line in lines] == ["monday", "tuesday"]


def test_what_was_cut_short_is_repaired_by_listing(runs: Call, store: RunStore) -> None:
    folder = store.recordings / "wednesday"
    folder.mkdir()
    cut = RunFile(folder / "part-0001.mcap", {"robot": "toy"})
    for record in read_records(store.get("monday").files[0]):
        cut.write(record)
    cut.flush()
    cut.abandon()
    assert not is_finished(cut.path)
    found = {row["id"]: row for row in runs("list", "--json")}
    assert found["wednesday"]["complete"]
    assert found["wednesday"]["messages"] == found["monday"]["messages"]


def test_a_run_is_shown_with_its_topics_and_events(runs: Call) -> None:
    told = runs("show", "monday", "--json")
    assert told["about"]["robot"] == "toy"
    actions = told["topics"]["/toy/action"]
    assert (actions["type"], actions["messages"], actions["lost"]) == (
        "std_msgs/msg/Float64MultiArray",
        16,
        0,
    )
    assert [event["outcome"] for event in told["events"]] == ["success", "failure"]
    assert "/toy/camera/front/image" in runs("show", "latest")


def test_runs_are_exported_as_one_file(runs: Call, store: RunStore, tmp_path: Path) -> None:
    target = tmp_path / "a folder that is not there" / "both.mcap"
    runs("export", "monday", "tuesday", "--mcap", str(target))
    assert is_finished(target)
    wanted = [
        record
        for name in ("monday", "tuesday")
        for record in read_records(store.get(name).files[0])
    ]
    assert list(read_records(target)) == wanted
    with pytest.raises(ConfigurationError, match="exists"):
        runs("export", "monday", "--mcap", str(target))


def test_all_runs_become_a_data_set_by_outcome(runs: Call, tmp_path: Path) -> None:
    told = runs(
        "export",
        "all",
        "--lerobot",
        str(tmp_path / "set"),
        "--outcome",
        "success",
        "--codec",
        "h264",
    )
    assert "2 episodes, 16 frames at 10 Hz" in told
    assert (tmp_path / "set/meta/info.json").exists()


def test_a_run_is_deleted_only_with_consent(
    runs: Call, store: RunStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    with pytest.raises(InvalidInputError, match="Nobody can be asked"):
        runs("delete", "monday")
    assert "Deleted: monday" in runs("delete", "monday", "--yes")
    assert [run.id for run in store.runs()] == ["tuesday"]
    with pytest.raises(InvalidInputError, match="No run begins with 'monday'"):
        runs("show", "monday")

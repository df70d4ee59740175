"""Exported data sets: rows equal the recording bit for bit, episodes are cut by instruction and
outcome.
"""

from __future__ import annotations

import errno
import json
import subprocess
import sys
from argparse import ArgumentParser
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from recorder_demonstrations import action, picture, record_run, rewritten, store_in
from recorder_expectations import expected_episode

from rn_recorder_runs.command import Runs
from rn_recorder_runs.files import Record
from rn_recorder_runs.lerobot import export
from rn_recorder_runs.statistics import merge, stats_of
from rn_recorder_runs.store import RunStore
from rn_recorder_runs.video import Codec
from roboneuron import (
    ConfigurationError,
    InvalidInputError,
    MissingDependencyError,
    StateError,
)

ROOT = Path(__file__).parents[3]
LEROBOT = ROOT / ".venv-lerobot" / "bin" / "python"
DEMOS = ROOT / "out" / "demos"
needs_lerobot = pytest.mark.skipif(
    not (ROOT / ".venv-lerobot" / ".ready").exists(),
    reason="lerobot's environment is not there: make .venv-lerobot",
)
TWO = [("pick up the cup", "success"), ("put it down", "failure")]


def frames_of(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_rows_equal_the_recording(tmp_path: Path) -> None:
    run = record_run(store_in(tmp_path), "demo", TWO)
    written = export([run], tmp_path / "set", outcome=None, fps=None, codec="h264")
    assert (written.episodes, written.frames, written.fps) == (2, 16, 10)
    table = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet").to_pydict()
    np.testing.assert_array_equal(
        table["roboneuron.action"], [action(number) for number in range(16)]
    )
    np.testing.assert_array_equal(
        table["action"], [action(number).astype(np.float32) for number in range(16)]
    )
    assert np.diff(table["roboneuron.seen_ns"]).tolist() == [100_000_000] * 15
    assert (
        np.array(table["roboneuron.sent_ns"]) - np.array(table["roboneuron.seen_ns"]) == 30_000_000
    ).all()
    assert table["episode_index"] == [0] * 8 + [1] * 8
    assert table["frame_index"] == [*range(8), *range(8)]
    np.testing.assert_allclose(table["timestamp"][:8], np.arange(8) / 10, atol=1e-6)  # float32
    for camera in ("front", "hand"):
        video = frames_of(
            tmp_path / f"set/videos/observation.images.{camera}/chunk-000/file-000.mp4"
        )
        assert len(video) == 16
        for number, image in enumerate(video):
            error = np.abs(image.astype(int) - picture(camera, number)).mean()
            # H.264 at crf 23; a neighbour differs by more than 12
            assert error < 4, (camera, number)


def test_units_frames_and_origin_are_told(tmp_path: Path) -> None:
    run = record_run(store_in(tmp_path), "demo", TWO)
    export([run], tmp_path / "set", outcome=None, fps=None, codec="h264")
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert info["features"]["action"]["names"] == [
        "dx_m",
        "dy_m",
        "dz_m",
        "rx_rad",
        "ry_rad",
        "rz_rad",
        "gripper_open",
    ]
    assert info["features"]["observation.state"]["names"] == ["shoulder", "elbow", "finger"]
    origin = json.loads((tmp_path / "set/meta/roboneuron.json").read_text())
    assert origin["contract"] == {"action": "m, rad"}
    assert [(e["instruction"], e["outcome"]) for e in origin["episodes"]] == TWO
    episodes = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pydict()
    assert episodes["dataset_to_index"] == [8, 16]
    assert episodes["videos/observation.images.front/from_timestamp"] == [0.0, 0.8]


def test_episodes_are_selected_by_outcome(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    runs = [
        record_run(store, "one", TWO),
        record_run(store, "two", [("pick up the cup", "success")]),
    ]
    written = export(runs, tmp_path / "set", outcome="success", fps=None, codec="h264")
    assert written.episodes == 2
    tasks = pq.read_table(tmp_path / "set/meta/tasks.parquet").to_pydict()
    assert tasks["task"] == ["pick up the cup"]
    with pytest.raises(ConfigurationError, match="exists"):
        export(runs, tmp_path / "set", outcome=None, fps=None, codec="h264")
    with pytest.raises(InvalidInputError, match="No episode with the outcome 'unknown'"):
        export(runs, tmp_path / "other", outcome="unknown", fps=None, codec="h264")


def losing_image(number: int) -> Callable[[Record], Record | None]:
    seen: list[Record] = []

    def change(record: Record) -> Record | None:
        if record.topic.endswith("front/image"):
            seen.append(record)
            return None if len(seen) - 1 == number else record
        return record

    return change


def test_a_lost_image_leaves_out_its_episode_only(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    whole = record_run(store, "whole", TWO)
    lossy = rewritten(record_run(store, "other", TWO), "lossy", losing_image(11))
    written = export([whole, lossy], tmp_path / "set", outcome=None, fps=None, codec="h264")
    assert (written.episodes, written.frames) == (3, 24)
    (left,) = written.skipped
    assert (left.run, left.instruction) == ("lossy", "put it down")
    assert (
        "1 of its 8 images of camera 'front' are lost or damaged, the first at 0.30 s" in left.why
    )
    table = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet").to_pydict()
    assert table["episode_index"] == [0] * 8 + [1] * 8 + [2] * 8
    video = frames_of(tmp_path / "set/videos/observation.images.front/chunk-000/file-000.mp4")
    for number, image in zip((*range(16), *range(8)), video, strict=True):
        assert np.abs(image.astype(int) - picture("front", number)).mean() < 4


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda record: None if record.topic.endswith("/action") else record, "holds no actions"),
        (lambda record: None if record.topic.endswith("/image") else record, "holds no images"),
        (lambda record: None if "hand" in record.topic else record, "other cameras"),
        (
            lambda record: (
                replace(record, data=record.data[:200])
                if record.topic.endswith("/image")
                else record
            ),
            "images of camera 'front' are lost or damaged",
        ),
    ],
    ids=["no actions", "no images", "another camera", "damaged images"],
)
def test_a_run_that_lacks_something_leaves_the_others_whole(
    tmp_path: Path, change, why: str
) -> None:
    store = store_in(tmp_path)
    whole = record_run(store, "whole", TWO)
    bad = rewritten(record_run(store, "other", TWO[:1]), "bad", change)
    written = export([bad, whole], tmp_path / "set", outcome=None, fps=None, codec="h264")
    assert (written.episodes, written.frames) == (2, 16)
    assert {left.run for left in written.skipped} == {"bad"}
    assert why in written.skipped[0].why


def test_an_export_that_fails_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = store_in(tmp_path)
    lossy = rewritten(record_run(store, "other", TWO[:1]), "lossy", losing_image(2))
    target = tmp_path / "out" / "set"
    target.parent.mkdir()
    with pytest.raises(InvalidInputError, match="can be exported") as refusal:
        export([lossy], target, outcome=None, fps=None, codec="h264")
    assert "lossy: 1 of its 8 images" in refusal.value.hint
    assert list(target.parent.iterdir()) == []

    def full(table: object, path: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(pq, "write_table", full)
    with pytest.raises(StateError, match=r"file-000\.parquet cannot be written: No space left"):
        export([store.get("other")], target, outcome=None, fps=None, codec="h264")
    assert list(target.parent.iterdir()) == []


def test_the_command_names_what_it_leaves_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = store_in(tmp_path)
    run = record_run(store, "whole", TWO)
    rewritten(run, "lossy", losing_image(2))
    parser = ArgumentParser()
    command = Runs()
    command.configure(parser)
    words = [
        "--directory",
        str(store.directory),
        "export",
        "all",
        "--lerobot",
        str(tmp_path / "set"),
        "--codec",
        "h264",
    ]
    assert command.run(parser.parse_args(words)) == 1
    told = capsys.readouterr()
    assert "3 episodes, 24 frames" in told.out
    assert "Left out: the episode 'pick up the cup' of lossy: 1 of its 8 images" in told.err


def test_statistics_of_parts_merge_into_those_of_the_whole() -> None:
    values = np.random.default_rng(0).normal(size=(300, 4))
    merged, whole = merge([stats_of(values[:100]), stats_of(values[100:])]), stats_of(values)
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(getattr(merged, name), getattr(whole, name), atol=1e-12)
    assert merged.count == 300


def opened_by_lerobot(dataset: Path, expected: Path) -> str:
    """What the check in lerobot's environment says of a data set; it must not fail."""
    checker = Path(__file__).with_name("lerobot_check.py")
    command = [str(LEROBOT), str(checker), str(dataset), str(expected)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=1500, check=False, env={"PATH": "/usr/bin"}
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
@needs_lerobot
def test_lerobot_opens_it_and_finds_what_was_recorded(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    runs = [
        record_run(store, name, [(text, "success")])
        for name, text in (("one", "pick it up"), ("two", "put it"))
    ]
    export(runs, tmp_path / "set", outcome=None, fps=None, codec="av1")
    (tmp_path / "expected").mkdir()
    for number, run in enumerate(runs):
        np.savez(tmp_path / "expected" / f"{number}.npz", **expected_episode(run.files[0]))
    assert "2 episodes, 16 frames equal" in opened_by_lerobot(
        tmp_path / "set", tmp_path / "expected"
    )


@pytest.mark.slow
@needs_lerobot
@pytest.mark.parametrize("codec", ["av1", "h264"])
def test_lerobots_own_writer_gives_the_same_data_set(tmp_path: Path, codec: Codec) -> None:
    store = store_in(tmp_path)
    runs = [
        record_run(store, name, [(text, "success"), ("put it down", "success")])
        for name, text in (("one", "pick it up"), ("two", "turn it"))
    ]
    own, theirs = tmp_path / "own", tmp_path / "theirs"
    written = export(runs, own, outcome=None, fps=None, codec=codec)
    assert written == export(
        runs, theirs, outcome=None, fps=None, codec=codec, with_lerobot=LEROBOT
    )
    assert names_in(own) == names_in(theirs)
    for name in ("data/chunk-000/file-000.parquet", "meta/tasks.parquet"):
        found, expected = pq.read_table(own / name), pq.read_table(theirs / name)
        assert {c: found[c] for c in found.column_names} == {
            c: expected[c] for c in expected.column_names
        }, name
    check_same_info(own / "meta/info.json", theirs / "meta/info.json")
    check_same_statistics(own / "meta/stats.json", theirs / "meta/stats.json")
    for camera in ("front", "hand"):
        name = f"videos/observation.images.{camera}/chunk-000/file-000.mp4"
        for one, other in zip(frames_of(own / name), frames_of(theirs / name), strict=True):
            # each may lose 4 to the codec
            assert np.abs(one.astype(int) - other).mean() < 8
    episodes = "meta/episodes/chunk-000/file-000.parquet"
    listed = [pq.read_table(folder / episodes).to_pydict() for folder in (own, theirs)]
    assert listed[0].keys() == listed[1].keys()
    for name in (name for name in listed[0] if not name.startswith("stats/")):
        if name == "tasks":
            assert listed[0][name] == listed[1][name]
        else:
            np.testing.assert_allclose(listed[0][name], listed[1][name], atol=1e-9, err_msg=name)


def names_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def check_same_info(own: Path, theirs: Path) -> None:
    """lerobot tells some settings of the encoder besides."""
    found, expected = (json.loads(path.read_text()) for path in (own, theirs))
    for name, feature in found["features"].items():
        other = expected["features"][name]
        told = feature.pop("info", {})
        assert told.items() <= other.pop("info", {}).items(), name
    assert found == expected


def check_same_statistics(own: Path, theirs: Path) -> None:
    found, expected = (json.loads(path.read_text()) for path in (own, theirs))
    assert found.keys() == expected.keys()
    for feature, values in found.items():
        assert values.keys() == expected[feature].keys()
        mean, low, high = (np.array(values[name]) for name in ("mean", "min", "max"))
        for name, value in values.items():
            got, wanted = np.array(value), np.array(expected[feature][name])
            assert got.shape == wanted.shape, (feature, name)
            if feature.startswith("observation.images."):
                # we draw other pixels than lerobot does
                tolerance: object = 0.05
            elif name == "std":
                # lerobot subtracts the square of the mean, in the precision of the values
                kind = np.float64 if feature.endswith("_ns") else np.float32
                tolerance = np.sqrt(np.finfo(kind).eps) * 2.0 * np.abs(mean)
            elif name.startswith("q"):
                # lerobot takes one of the 8 values of an episode, we go between two
                tolerance = (high - low) / 7
            else:
                tolerance = 1e-6 * np.maximum(np.abs(mean), high - low)
            assert (np.abs(got - wanted) <= np.maximum(tolerance, 1e-9)).all(), (feature, name)


@pytest.mark.parametrize(
    ("python", "error", "words"),
    [
        ("nowhere/python", ConfigurationError, "nowhere/python cannot be run: No such file"),
        (sys.executable, MissingDependencyError, "no lerobot that can be used: No module named"),
        ("/bin/false", StateError, "failed with status 1: it said nothing"),
        ("/bin/true", StateError, "failed with status 0"),
    ],
)
def test_an_interpreter_without_lerobot_is_refused_and_leaves_nothing(
    tmp_path: Path, python: str, error: type[Exception], words: str
) -> None:
    runs = [record_run(store_in(tmp_path), "demo", TWO, rows=40)]
    target = tmp_path / "out" / "set"
    target.parent.mkdir()
    with pytest.raises(error, match=words):
        export(runs, target, outcome=None, fps=None, codec="av1", with_lerobot=Path(python))
    assert list(target.parent.iterdir()) == []


@pytest.mark.slow
@needs_lerobot
@pytest.mark.timeout(1800)
@pytest.mark.skipif(
    not (DEMOS / "lerobot").exists(), reason="no demonstrations are there: make record-demos N=50"
)
def test_recorded_demonstrations_equal_their_files(tmp_path: Path) -> None:
    runs = [run for run in RunStore(DEMOS / "runs").runs() if run.facts["outcome"] == "success"]
    for number, run in enumerate(runs):
        np.savez(tmp_path / f"{number:05d}.npz", **expected_episode(run.files[0]))
    told = opened_by_lerobot(DEMOS / "lerobot", tmp_path)
    print(told)
    assert told.startswith(f"{len(runs)} episodes, ")

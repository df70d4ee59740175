"""Ring, parts, quota and age of runs."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from recorder_rig import START_NS, Clock, feed, recording

from rn_recorder_runs.channels import latched_channel
from rn_recorder_runs.files import (
    read_records,
)
from rn_recorder_runs.transforms import CameraMount, RobotTransforms
from roboneuron import InvalidInputError, StateError


def test_the_ring_holds_the_last_seconds_and_no_more(tmp_path: Path, clock: Clock) -> None:
    made = recording(tmp_path, clock)
    feed(made, clock, 100)
    kept = [
        entry.log_ns
        for path in sorted(made.store.ring.glob("*.mcap"))
        for entry in read_records(path)
    ]
    assert clock.ns() - min(kept) >= 30e9
    assert clock.ns() - min(kept) <= 42e9
    made.close()


def test_parts_are_rotated_and_the_oldest_go_first(tmp_path: Path, clock: Clock) -> None:
    made = recording(tmp_path, clock, ring_s=0, part_s=4, quota_bytes=40_000)
    run = made.start("long", {})
    number = feed(made, clock, 60)
    parts = made.store.get(run).files
    assert len(parts) < 60 / 4
    assert parts[0].name != "part-0001.mcap"
    done = made.stop({"outcome": "success"})
    assert done["outcome"] == "success"
    assert sum(path.stat().st_size for path in parts) <= 50_000
    held = [entry.sequence for path in made.store.get(run).files for entry in read_records(path)]
    assert held == list(range(held[0], number + 1))  # nothing is lost between two parts
    made.close()


def test_a_run_that_is_being_recorded_is_not_deleted(tmp_path: Path, clock: Clock) -> None:
    made = recording(tmp_path, clock)
    run = made.start("demo", {})
    held = made.store.lock()
    assert held is not None
    with pytest.raises(StateError, match="is being recorded"):
        made.store.delete(made.store.get(run))
    assert made.store.repair() == []
    made.close()
    made.store.delete(made.store.get(run))
    with pytest.raises(InvalidInputError, match="No run begins"):
        made.store.get(run)


def test_files_are_deleted_for_their_age(tmp_path: Path, clock: Clock) -> None:
    made = recording(tmp_path, clock, keep_s=3 * 86_400.0)
    folder = made.store.recordings / "old"
    folder.mkdir()
    names = ["part-0001.mcap", "part-0002.mcap"]
    for name in names:
        (folder / name).write_bytes(b"x")
    incident = made.store.incidents / "old.mcap"
    incident.write_bytes(b"x")
    young = made.store.incidents / "young.mcap"
    young.write_bytes(b"x")
    for path in (incident, folder / names[0], folder / names[1]):
        os.utime(path, (START_NS / 1e9 - 4 * 86_400,) * 2)
    os.utime(young, (START_NS / 1e9 - 2 * 86_400,) * 2)
    feed(made, clock, 2)
    assert not folder.exists()
    assert [path.name for path in made.store.incidents.iterdir()] == ["young.mcap"]
    made.close()


def test_every_file_begins_with_what_is_latched(tmp_path: Path, clock: Clock) -> None:
    made = recording(tmp_path, clock, part_s=4.0)
    made.latched.channels["/tf_static"] = latched_channel()
    static = RobotTransforms(
        "",
        [
            CameraMount(
                parent="base", frame_id="eye", position_m=(1, 2, 3), quaternion_xyzw=(0, 0, 0, 1)
            )
        ],
    ).static(clock.ns())
    made.take(static)
    number = feed(made, clock, 60, rate=4)
    run = made.start("demo", {})
    begun_ns = clock.ns()
    number = feed(made, clock, 10, rate=4, number=number)
    made.stop({})
    name = made.incident("control-silent", {})
    feed(made, clock, 6, rate=4, number=number)
    made.close()
    parts = made.store.get(run).files
    assert len(parts) == 3
    for path in (*parts, *made.store.get(name).files):
        held = [entry for entry in read_records(path) if entry.topic == "/tf_static"]
        assert [entry.data for entry in held] == [static.data]
        first = next(iter(read_records(path)))
        assert first.topic == "/tf_static"
    assert min(entry.log_ns for path in parts for entry in read_records(path)) > begun_ns

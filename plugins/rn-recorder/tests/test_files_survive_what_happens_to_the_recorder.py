"""Files that are cut short, full disks, directories that cannot be written, and a backlog."""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recorder_rig import Clock, feed, record, recording

from rn_recorder_runs.files import RunFile, is_finished, read_about, read_records
from rn_recorder_runs.node import Backlog
from rn_recorder_runs.reading import count_topics
from rn_recorder_runs.recording import Recording, Rules
from rn_recorder_runs.repairing import repair
from rn_recorder_runs.store import Run, RunStore
from roboneuron import StateError


def test_a_file_cut_anywhere_opens_and_holds_all_whole_chunks(tmp_path: Path) -> None:
    path = tmp_path / "whole.mcap"
    file = RunFile(path, {"robot": "gantry"})
    ends = []
    for number in range(1, 41):
        file.write(record(number))
        if number % 10 == 0:
            file.flush()
            ends.append((file.size_bytes, number))
    file.finish()
    data = path.read_bytes()

    @settings(max_examples=40)
    @given(st.integers(min_value=0, max_value=len(data) - 1))
    def check(length: int) -> None:
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(data[:length])
        kept = max((number for end, number in ends if end <= length), default=0)
        assert not is_finished(cut)
        assert repair(cut)
        assert is_finished(cut)
        found = [entry.sequence for entry in read_records(cut)]
        assert found[:kept] == list(range(1, kept + 1))

    check()
    assert not repair(path)
    assert read_about(path)["robot"] == "gantry"
    assert count_topics([path])["/told"].lost == 0


def test_what_a_killed_recorder_loses_is_at_most_half_a_second(
    tmp_path: Path, clock: Clock
) -> None:
    made = recording(tmp_path, clock, ring_s=0)
    run = made.start("demo", {})
    last = feed(made, clock, 5.03)
    # as it is on disk now
    found = [entry.sequence for entry in read_records(made.store.get(run).files[0])]
    assert found == list(range(1, len(found) + 1))
    assert last - len(found) <= 0.5 * 20 + 1
    del made  # never closed
    store = RunStore(tmp_path / "runs")
    assert store.repair() == list(store.get(run).files)
    assert store.get(run).is_complete


def kept(run: Run) -> int:
    return sum(1 for path in run.files for _ in read_records(path))


def test_a_full_disk_costs_messages_that_are_counted_and_nothing_else(
    tmp_path: Path, clock: Clock
) -> None:
    made = recording(tmp_path, clock, ring_s=0)
    run = made.start("demo", {})
    number = feed(made, clock, 3)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    size = made.store.get(run).files[0].stat().st_size
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size + 100, hard))  # the next chunk does not fit
        number = feed(made, clock, 1.6, number=number)
        assert made.state()["problem"]
        assert made.state()["lost_to_disk"] > 0
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    number = feed(made, clock, 3, number=number)
    assert made.state()["problem"] == ""
    lost = made.state()["lost_to_disk"]
    made.close()
    made.store.repair()
    files = made.store.get(run).files
    assert kept(made.store.get(run)) + lost == number
    # tries that failed leave nothing
    assert all(any(True for _ in read_records(path)) for path in files)
    assert len(files) >= 2
    assert all(is_finished(path) for path in files)
    assert len(list(read_records(files[0]))) >= 40


FULL = """
import json, sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_files_survive_what_happens_to_the_recorder import Clock, feed, kept, recording
from rn_recorder_runs.files import is_finished

folder, clock = Path(sys.argv[1]), Clock()
made = recording(folder, clock, ring_s=0)
run = made.start("demo", {})
number = feed(made, clock, 3)
filler = folder / "filler"
with filler.open("wb", buffering=0) as file:
    try:
        while True:
            file.write(bytes(4096))
    except OSError:
        pass
number = feed(made, clock, 5, number=number)
problem = made.state()["problem"]
filler.unlink()
number = feed(made, clock, 5, number=number)
told = {"problem": problem, "then": made.state()["problem"], "lost": made.state()["lost_to_disk"], "fed": number}
made.close()
made.store.repair()
found = made.store.get(run)
told |= {"kept": kept(found), "files": len(found.files), "open": all(is_finished(path) for path in found.files)}
print(json.dumps(told))
"""  # noqa: E501


def test_a_disk_without_space_is_written_again_when_there_is_some(
    tmp_path: Path, run_unguarded: Callable[[Callable[[], Any]], Any]
) -> None:
    """A real one, of 1 MB, in a mount namespace of its own."""
    mount = f"mount -t tmpfs -o size=1m none {tmp_path}"
    tried = ["unshare", "-rm", "sh", "-c", mount]
    if run_unguarded(lambda: subprocess.run(tried, capture_output=True, check=False).returncode):
        pytest.skip("this machine lets nobody mount a small disk in a namespace")
    script = f'{mount} && exec "$0" -c "$1" {tmp_path} {Path(__file__).parent}'
    command = ["unshare", "-rm", "sh", "-c", script, sys.executable, FULL]
    done = run_unguarded(
        lambda: subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["problem"] == "No space left on device"
    assert told["then"] == ""
    assert told["lost"] > 0
    assert told["kept"] + told["lost"] >= told["fed"]  # nothing is lost uncounted
    assert told["files"] >= 2
    assert told["open"]


def test_too_little_free_space_ends_the_part_with_an_index(tmp_path: Path, clock: Clock) -> None:
    made = recording(tmp_path, clock, ring_s=0, min_free_bytes=0)
    run = made.start("demo", {})
    feed(made, clock, 2)
    made.rules = Rules(ring_s=0, min_free_bytes=shutil.disk_usage(tmp_path).total)
    feed(made, clock, 2)
    assert "are free on the disk" in made.state()["problem"]
    assert all(is_finished(path) for path in made.store.get(run).files)


def test_a_directory_that_cannot_be_written_is_told_and_disturbs_nobody(
    tmp_path: Path, clock: Clock
) -> None:
    (tmp_path / "runs").write_text("a file where the directory should be")
    made = Recording(
        RunStore(tmp_path / "runs"), Rules(), {}, clock_ns=clock.ns, monotonic=clock.monotonic
    )
    with pytest.raises(OSError, match="runs"):
        made.adopt()
    feed(made, clock, 1)
    assert made.state()["problem"]
    with pytest.raises(StateError, match="cannot be written"):
        made.start("demo", {})
    made.incident("robot-exited", {})
    (tmp_path / "runs").unlink()
    feed(made, clock, 10)
    made.close()
    assert [run.kind for run in made.store.runs()] == ["incident"]


def test_a_backlog_drops_and_counts_what_does_not_fit() -> None:
    backlog = Backlog(most_bytes=1000)
    for number in range(10):
        backlog.put(record(number))
    kept = 0
    while backlog.get() is not None:
        kept += 1
    assert backlog.dropped == 10 - kept > 0
    backlog.put(record(1))
    assert backlog.get() is not None

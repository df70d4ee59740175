"""Incidents: one file each, with the time around the fault."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from recorder_rig import Clock, feed, record, recording

from rn_recorder_runs.files import (
    is_finished,
    read_attachments,
    read_records,
)
from rn_recorder_runs.reading import count_topics


def test_an_incident_is_one_file_with_the_time_around_it(tmp_path: Path, clock: Clock) -> None:
    made = recording(tmp_path, clock)
    number = feed(made, clock, 50)
    at_ns = clock.ns()
    name = made.incident("control-silent", {"explanation": "it says nothing"})
    number = feed(made, clock, 2, number=number)
    assert made.incident("inference-failing", {}) == name  # the same trouble
    feed(made, clock, 10, number=number)
    made.close()
    incident = made.store.get(name)
    kept = [entry.log_ns for entry in read_records(incident.files[0])]
    assert at_ns - 30e9 <= min(kept) <= at_ns - 29.8e9
    assert at_ns + 6.8e9 <= max(kept) <= at_ns + 7e9  # 5 s after the newest fault
    told = json.loads(read_attachments(incident.files[0])["incident.json"])
    assert [fact["what"] for fact in told] == ["control-silent", "inference-failing"]
    assert is_finished(incident.files[0])


def test_an_incident_is_written_by_the_next_recorder_when_this_one_dies(
    tmp_path: Path, clock: Clock
) -> None:
    made = recording(tmp_path, clock)
    number = feed(made, clock, 20)
    name = made.incident("robot-exited", {})
    feed(made, clock, 2, number=number)
    del made
    after = recording(tmp_path, clock)
    assert [run.id for run in after.store.runs()] == [name]
    assert count_topics(after.store.get(name).files)["/told"].messages >= 21 * 20
    assert not list(after.store.ring.iterdir())


def test_faults_that_follow_each_other_are_one_incident(tmp_path: Path, clock: Clock) -> None:
    """An overload of twelve minutes was 63 files, each of which repeated the 30 s before it."""
    made = recording(tmp_path, clock)
    number = feed(made, clock, 40, rate=4)
    begun_ns = clock.ns()
    for _ in range(12):
        made.incident("inference-slow", {})
        number = feed(made, clock, 11, rate=4, number=number)
    feed(made, clock, 40, rate=4, number=number)
    made.close()
    (run,) = [run for run in made.store.runs() if run.kind == "incident"]
    found = list(read_records(run.files[0]))
    times = [entry.log_ns for entry in found]
    assert times == sorted(times)
    assert len({entry.sequence for entry in found}) == len(found)
    assert begun_ns - 30e9 <= times[0] <= begun_ns - 29.5e9
    assert times[-1] - begun_ns == pytest.approx((11 * 11 + 5) * 1e9, abs=0.3e9)
    assert max(np.diff(times)) < 0.3e9  # nothing is missing between the faults
    assert len(json.loads(read_attachments(run.files[0])["incident.json"])) == 12
    assert made.incidents_written == [run.id]


def test_faults_that_never_cease_do_not_keep_back_the_file(tmp_path: Path, clock: Clock) -> None:
    made = recording(tmp_path, clock)
    number = feed(made, clock, 10)
    name = made.incident("control-silent", {})
    for _ in range(6):
        number = feed(made, clock, 1, number=number)
        made.incident("control-silent", {})
    made._cutting.join()  # type: ignore[union-attr]
    assert made.store.get(name).is_complete
    feed(made, clock, 10, number=number)
    made.close()
    times = [entry.log_ns for entry in read_records(made.store.get(name).files[0])]
    assert times == sorted(set(times))
    # from the beginning to 5 s after the newest fault
    assert times[-1] - times[0] == pytest.approx(21e9, abs=0.2e9)


def test_a_message_that_is_written_late_is_in_the_incident(tmp_path: Path, clock: Clock) -> None:
    """It came before the first cut and was written after it, as under load."""
    made = recording(tmp_path, clock)
    number = feed(made, clock, 10)
    name = made.incident("control-silent", {})
    number = feed(made, clock, 3, number=number)
    made.incident("control-silent", {})
    number = feed(made, clock, 2.5, number=number)
    late = record(100_000, clock.ns() - 1_000_000_000)
    made.take(late)
    feed(made, clock, 5, number=number)
    made.close()
    found = [entry.sequence for entry in read_records(made.store.get(name).files[0])]
    assert found.count(late.sequence) == 1
    assert len(found) == len(set(found))


def test_the_first_fault_has_its_file_soon(tmp_path: Path, clock: Clock) -> None:
    made = recording(tmp_path, clock)
    number = feed(made, clock, 10)
    name = made.incident("control-silent", {})
    number = feed(made, clock, 6, number=number)
    made._cutting.join()  # type: ignore[union-attr]
    assert made.store.get(name).is_complete
    feed(made, clock, 30, number=number)
    assert made.incident("control-silent", {}) != name  # long after it: another one
    made.close()


def test_an_incident_without_end_is_cut_into_several(tmp_path: Path, clock: Clock) -> None:
    made = recording(tmp_path, clock, incident_s=60.0)
    number = feed(made, clock, 10, rate=4)
    names = []
    for _ in range(30):
        names.append(made.incident("inference-slow", {}))
        number = feed(made, clock, 5, rate=4, number=number)
    made.close()
    assert len(set(names)) == 3
    for run in made.store.runs():
        times = [entry.log_ns for entry in read_records(run.files[0])]
        assert times[-1] - times[0] <= 95e9

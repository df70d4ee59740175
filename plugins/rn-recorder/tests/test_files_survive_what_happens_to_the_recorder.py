"""Files that are cut short, full disks, directories that cannot be written; ring, parts, quota and
incidents.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rn_recorder_runs.channels import latched_channel
from rn_recorder_runs.files import (
    Record,
    RunFile,
    is_finished,
    read_about,
    read_attachments,
    read_records,
    repair,
)
from rn_recorder_runs.images import IMAGE, MessageError, parse_image, to_string
from rn_recorder_runs.node import Backlog
from rn_recorder_runs.reading import RecordDecoder, count_topics, iterate
from rn_recorder_runs.recording import Recording, Rules
from rn_recorder_runs.schemas import definition
from rn_recorder_runs.store import Run, Store
from rn_recorder_runs.transforms import CameraMount, RobotTransforms
from roboneuron import InvalidInputError, StateError

STRING = "std_msgs/msg/String"
START_NS = 1_700_000_000_000_000_000


def record(number: int, at_ns: int | None = None, topic: str = "/told") -> Record:
    at = START_NS + number * 10_000_000 if at_ns is None else at_ns
    return Record(topic, STRING, at, at - 1000, number, to_string(f"message {number} " + "x" * 200))


class Clock:
    """Wall clock and monotonic clock that a test sets."""

    def __init__(self) -> None:
        self.s = 0.0

    def ns(self) -> int:
        return START_NS + round(self.s * 1e9)

    def monotonic(self) -> float:
        return self.s


@pytest.fixture
def clock() -> Clock:
    return Clock()


def recording(tmp_path: Path, clock: Clock, **rules: float) -> Recording:
    made = Recording(
        Store(tmp_path / "runs"),
        Rules(**{"min_free_bytes": 0, **rules}),  # type: ignore[arg-type]
        {"robot": "gantry"},
        clock_ns=clock.ns,
        monotonic=clock.monotonic,
    )
    made.adopt()
    return made


def feed(made: Recording, clock: Clock, seconds: float, rate: int = 20, number: int = 0) -> int:
    for _ in range(round(seconds * rate)):
        number += 1
        clock.s += 1 / rate
        made.take(record(number, clock.ns()))
        made.tick()
    return number


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
    store = Store(tmp_path / "runs")
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


def test_a_disk_without_space_is_written_again_when_there_is_some(tmp_path: Path) -> None:
    """A real one, of 1 MB, in a mount namespace of its own."""
    mount = f"mount -t tmpfs -o size=1m none {tmp_path}"
    if subprocess.run(
        ["unshare", "-rm", "sh", "-c", mount], capture_output=True, check=False
    ).returncode:
        pytest.skip("this machine lets nobody mount a small disk in a namespace")
    script = f'{mount} && exec "$0" -c "$1" {tmp_path} {Path(__file__).parent}'
    command = ["unshare", "-rm", "sh", "-c", script, sys.executable, FULL]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
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
        Store(tmp_path / "runs"), Rules(), {}, clock_ns=clock.ns, monotonic=clock.monotonic
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


@pytest.fixture
def image_message() -> tuple[bytes, np.ndarray]:
    from rclpy.serialization import serialize_message

    from roboneuron import Frame
    from roboneuron.ros.messages import to_image

    ramp = np.linspace(0, 255, 64 * 48 * 3).astype(np.uint8).reshape(48, 64, 3)
    frame = Frame(camera="front", image=ramp, stamp_ns=START_NS + 5, frame_id="front_optical")
    return bytes(serialize_message(to_image(frame))), ramp


def test_images_are_read_and_encoded_without_ros(
    image_message: tuple[bytes, np.ndarray], tmp_path: Path
) -> None:
    from rn_recorder_runs.images import COMPRESSED, pixels_of, to_jpeg

    message, ramp = image_message
    raw = parse_image(message)
    assert (raw.stamp_ns, raw.width, raw.height, raw.frame_id) == (
        START_NS + 5,
        64,
        48,
        b"front_optical",
    )
    encoded = to_jpeg(message, 95)
    assert encoded is not None
    with pytest.raises(MessageError):
        parse_image(message[:100])
    path = tmp_path / "images.mcap"
    file = RunFile(path, {})
    file.write(Record("/camera/front/image", IMAGE, START_NS, START_NS, 1, message))
    file.write(Record("/camera/front/image/compressed", COMPRESSED, START_NS, START_NS, 1, encoded))
    file.finish()
    whole, small = (found for found in iterate([path], lambda topic: True))
    np.testing.assert_array_equal(pixels_of(whole.message, IMAGE), ramp)
    decoded = pixels_of(small.message, COMPRESSED)
    assert np.abs(decoded.astype(int) - ramp).mean() < 6  # what JPEG takes from a steep ramp
    assert small.message.header.frame_id == "front_optical"
    assert small.message.format == "rgb8; jpeg compressed bgr8"


@pytest.mark.parametrize(
    "name",
    [
        "sensor_msgs/msg/Image",
        "diagnostic_msgs/msg/DiagnosticArray",
        "trajectory_msgs/msg/JointTrajectory",
    ],
)
def test_definitions_are_complete(name: str) -> None:
    from importlib import import_module

    from rclpy.serialization import serialize_message

    package, kind, short = name.split("/")
    message = getattr(import_module(f"{package}.{kind}"), short)()
    message.header.frame_id = "base"
    decoder = RecordDecoder()
    decoder.definitions[name] = definition(name)
    decoded = decoder.decode(Record("/t", name, 0, 0, 0, bytes(serialize_message(message))))
    assert decoded.header.frame_id == "base"


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

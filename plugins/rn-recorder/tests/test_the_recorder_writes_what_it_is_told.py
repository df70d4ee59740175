"""The recorder's process without ROS: what the server tells it and what the audit holds comes into
the files.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import serialize_message

from rn_recorder_runs.files import Record, read_attachments
from rn_recorder_runs.images import IMAGE, pixels_of
from rn_recorder_runs.node import RecorderWorker
from rn_recorder_runs.reading import count_topics, iterate
from rn_recorder_runs.settings import RecorderSettings, RulesSettings
from rn_recorder_runs.store import Run
from roboneuron import Frame
from roboneuron.ros.messages import to_image

BEGIN_NS = 1_700_000_000_000_000_000
RULES = RulesSettings(
    ring_s=30, after_s=0, part_bytes=60_000, part_s=600, quota_bytes=10**9, min_free_bytes=0
)


def picture(number: int) -> np.ndarray:
    ramp = np.linspace(0, 200, 64)
    return np.stack([np.tile(ramp, (48, 1)) + number] * 3, axis=-1).astype(np.uint8)


def image_record(number: int) -> Record:
    at_ns = BEGIN_NS + number * 10**8
    frame = Frame(camera="front", image=picture(number), stamp_ns=at_ns, frame_id="front")
    return Record(
        "/toy/camera/front/image",
        IMAGE,
        at_ns,
        at_ns,
        number,
        bytes(serialize_message(to_image(frame))),
    )


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., RecorderWorker]:
    """Return a function that makes a recorder whose turns the test makes."""

    def make(images: Any, tell: Callable[[Any], object] = lambda line: None) -> RecorderWorker:
        settings = RecorderSettings(
            namespace="toy",
            state_directory=tmp_path,
            directory=tmp_path / "runs",
            topics=("*",),
            exclude=(),
            images=images,
            jpeg_quality=90,
            rules=RULES,
            about={"robot": "toy"},
        )
        process = RecorderWorker(settings, tell)
        process.recording.store.make()
        process._orders.append({"do": "start", "number": 1, "name": "demo", "facts": {}})
        process._turn()
        return process

    return make


def finished(process: RecorderWorker) -> list[Run]:
    process._turn()
    process.recording.close()
    return process.recording.store.runs()


def test_an_order_that_comes_too_late_is_not_obeyed(record: Callable[..., RecorderWorker]) -> None:
    process = record("lossless")
    active = process.recording.active_id
    now_s = time.monotonic()
    stop = {"do": "stop", "number": 2, "facts": {}}
    process._orders.append({**stop, "until_s": now_s - 1e-3})
    process._turn()
    assert process.recording.active_id == active
    process._orders.append({**stop, "until_s": now_s + 3600.0})
    process._turn()
    assert process.recording.active_id == ""
    process._orders.append(
        {"do": "start", "number": 3, "name": "late", "facts": {}, "until_s": now_s - 1e-3}
    )
    process._turn()
    assert process.recording.active_id == ""


def test_a_stop_of_another_recording_is_not_obeyed(record: Callable[..., RecorderWorker]) -> None:
    process = record("lossless")
    active = process.recording.active_id
    process._orders.append({"do": "stop", "number": 2, "run": "an-older-one", "facts": {}})
    process._turn()
    assert process.recording.active_id == active
    process._orders.append({"do": "stop", "number": 3, "run": active, "facts": {}})
    process._turn()
    assert process.recording.active_id == ""


def test_calls_changes_and_verdicts_are_in_the_file(
    record: Callable[..., RecorderWorker], tmp_path: Path
) -> None:
    process = record("lossless")
    told = [
        ("call", {"tool": "switch_inference", "arguments": {"backend": "other"}, "error": ""}),
        ("change", {"module": "inference", "names": {"backend": "other"}}),
        (
            "call",
            {"tool": "set_instruction", "arguments": {"instruction": "wave"}, "error": "refused"},
        ),
    ]
    for number, (what, facts) in enumerate(told):
        process._orders.append(
            {
                "do": "event",
                "what": what,
                "at_ns": BEGIN_NS + number,
                "facts": facts,
                "incident": "",
            }
        )
    lines = [
        {"verdict": "refused", "tool": "publish_cmd_vel", "rule": "bounds"},
        {"verdict": "latched", "who": "ann"},
    ]
    (tmp_path / "audit.jsonl").write_text(
        "".join(json.dumps({"time_ns": BEGIN_NS, **line}) + "\n" for line in lines)
    )
    runs = {run.kind: run for run in finished(process)}
    events = [
        json.loads(found.message.data)
        for found in iterate(runs["recording"].files, lambda t: "events" in t)
    ]
    assert [(event["what"], event.get("tool", "")) for event in events] == [
        ("call", "switch_inference"),
        ("change", ""),
        ("call", "set_instruction"),
    ]
    audit = [
        json.loads(found.message.data)
        for found in iterate(runs["recording"].files, lambda t: "audit" in t)
    ]
    assert [line["verdict"] for line in audit] == ["refused", "latched"]
    facts = json.loads(read_attachments(runs["incident"].files[0])["incident.json"])
    assert facts[0]["what"] == "emergency_stop"
    assert facts[0]["audit"]["who"] == "ann"


@pytest.mark.parametrize(("images", "worst"), [("jpeg", 4.0), ("lossless", 0.0)])
def test_images_are_kept_as_chosen(
    record: Callable[..., RecorderWorker], images: str, worst: float
) -> None:
    process = record(images)
    for number in range(1, 31):
        process.put(image_record(number))
    run = next(run for run in finished(process) if run.kind == "recording")
    ending = "/compressed" if images == "jpeg" else "/image"
    for number, found in enumerate(iterate(run.files, lambda topic: topic.endswith(ending)), 1):
        shown = pixels_of(found.message, found.record.type)
        assert np.abs(shown.astype(int) - picture(number)).mean() <= worst
    assert number == 30
    assert all(counts.lost == 0 for counts in count_topics(run.files).values())


def test_a_part_ends_when_it_is_large(record: Callable[..., RecorderWorker]) -> None:
    process = record("lossless")
    random = np.random.default_rng(0)
    active = process.recording._active
    assert active is not None
    for number in range(1, 61):
        data = random.bytes(5000)
        process.put(
            Record(
                "/toy/t", "std_msgs/msg/String", BEGIN_NS + number, BEGIN_NS + number, number, data
            )
        )
        process._turn()
        if active.sink.file is not None:
            active.sink.file.flush()  # which is due twice a second
    run = next(run for run in finished(process) if run.kind == "recording")
    assert len(run.files) > 2
    assert count_topics(run.files)["/toy/t"].messages == 60
    assert count_topics(run.files)["/toy/t"].lost == 0


def test_what_was_missed_before_a_recording_is_not_counted_as_its_own(
    record: Callable[..., RecorderWorker],
) -> None:
    told: list[dict[str, Any]] = []
    process = record("lossless", told.append)
    for missed in (7, 9):
        process.counts = lambda missed=missed: {"gaps": {"/toy/t": missed}}  # type: ignore[misc]
        process._orders.append({"do": "stop", "number": missed, "facts": {}})
        process._turn()
        process._orders.append({"do": "start", "number": 1, "name": f"run-{missed}", "facts": {}})
        process._turn()
    assert [answer["run"]["missed"] for answer in told if "run" in answer] == [7, 2]
    process.recording.close()

"""The recorder's process stays behind the control loop: by its priority, and by when it takes and
encodes messages.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rn_recorder_runs.files import Record
from rn_recorder_runs.tap import TopicTap
from rn_recorder_runs.video import CameraVideo, Codec

SHOW_POLICY = """
import os, threading
from rn_recorder_runs.priority import give_way

def show():
    print(os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

before = os.getpriority(os.PRIO_PROCESS, 0)
give_way()
print(before)
show()
thread = threading.Thread(target=show)
thread.start()
thread.join()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no SCHED_BATCH")
def test_its_threads_run_behind_those_of_others() -> None:
    output = subprocess.run(
        [sys.executable, "-c", SHOW_POLICY], capture_output=True, text=True, check=True, timeout=60
    )
    before, main, later = output.stdout.splitlines()
    assert main == later == f"{os.SCHED_BATCH} {min(19, int(before) + 10)}"


@pytest.mark.skipif(
    sys.platform != "linux" or os.geteuid() != 0, reason="only root's encoder takes a priority"
)
@pytest.mark.parametrize("codec", ["av1", "h264"])
def test_an_export_has_no_real_time_thread(codec: Codec, tmp_path: Path) -> None:
    before = os.sched_getscheduler(0)
    video = CameraVideo(tmp_path / "camera.mp4", 10, codec)
    video.add(np.zeros((64, 64, 3), np.uint8), times=3, every=1)
    tasks = [task.name for task in Path("/proc/self/task").iterdir()]
    policies = {os.sched_getscheduler(int(task)) for task in tasks}
    video.close()
    assert os.SCHED_FIFO not in policies
    assert os.sched_getscheduler(0) == before


class Handle:
    """A subscription's handle, with messages as (data, time of reception)."""

    def __init__(self, *messages: tuple[bytes, int]) -> None:
        self.waiting = list(messages)

    def take_message(self, message_type: object, raw: bool) -> tuple[bytes, dict[str, Any]] | None:
        assert raw
        if not self.waiting:
            return None
        data, came_ns = self.waiting.pop(0)
        return data, {
            "received_timestamp": came_ns,
            "source_timestamp": came_ns - 5,
            "publication_sequence_number": 0,
        }


def tap_of(
    monkeypatch: pytest.MonkeyPatch, now_ns: list[int], **handles: Handle
) -> tuple[TopicTap, list[Record]]:
    taken: list[Record] = []
    tap = TopicTap(SimpleNamespace(), ["*"], [], taken.append)  # type: ignore[arg-type]
    for name, handle in handles.items():
        subscription = SimpleNamespace(handle=handle, msg_type=object)
        tap._found[f"/{name}"] = (SimpleNamespace(depth=2), subscription)  # type: ignore[assignment]
        tap._types[f"/{name}"] = "std_msgs/msg/String"
    monkeypatch.setattr("rn_recorder_runs.tap.time", SimpleNamespace(time_ns=lambda: now_ns[0]))
    return tap, taken


def test_messages_of_a_turn_are_recorded_in_the_order_in_which_they_came(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_ns = [100]
    joints, image = (
        Handle((b"first", 10), (b"third", 30)),
        Handle((b"second", 20), (b"while it takes", 101)),
    )
    tap, taken = tap_of(monkeypatch, now_ns, joints=joints, image=image)
    tap._turn()
    assert [record.data for record in taken] == [b"first", b"second", b"third"]
    assert [(record.log_ns, record.publish_ns) for record in taken] == [(10, 5), (20, 15), (30, 25)]

    joints.waiting.append((b"before that", 100))
    now_ns[0] = 200
    tap._turn()
    assert [record.data for record in taken[3:]] == [b"before that", b"while it takes"]


def test_a_clock_that_is_set_back_holds_no_message_for_longer_than_a_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tap, taken = tap_of(monkeypatch, [100], joints=Handle((b"late", 10**9)))
    tap._turn()
    assert not taken
    tap._turn()
    assert [record.data for record in taken] == [b"late"]


def test_a_fast_topic_does_not_keep_a_turn_from_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    fast, slow = Handle(*((b"fast", at) for at in range(1, 9))), Handle((b"slow", 1))
    tap, taken = tap_of(monkeypatch, [100], fast=fast, slow=slow)
    tap._turn()
    assert sorted(record.data for record in taken) == [b"fast", b"fast", b"slow"]


def test_it_takes_messages_until_it_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    tap, _ = tap_of(monkeypatch, [100])
    monkeypatch.undo()
    leaving, turns = threading.Event(), []
    monkeypatch.setattr(tap, "look", lambda: turns.append("look"))

    def taken() -> None:
        turns.append("turn")
        if turns.count("turn") == 3:
            leaving.set()

    tap.run(leaving, taken)
    assert turns[0] == "look"
    assert turns.count("turn") == 3

"""A recorder that was stopped (SIGSTOP) and goes on: it hears its publishers again, and counts what
it missed.
"""

from __future__ import annotations

import json
import os
import signal
import threading
from pathlib import Path
from typing import Any

import pytest
from std_msgs.msg import String

from rn_recorder_runs.reading import count_topics
from rn_recorder_runs.settings import RecorderSettings, RulesSettings, spawn_recorder
from rn_recorder_runs.store import RunStore
from rn_testing.domain import free_ros_domain
from rn_testing.waiting import wait_until
from roboneuron.ros.environment import prepare_environment
from roboneuron.ros.link import RosLink
from roboneuron.ros.qos import NEWEST

TOPIC, RATE_HZ, FROZEN = "/toy/told", 400.0, 1000
RULES = RulesSettings(
    ring_s=0, after_s=1, part_bytes=10**8, part_s=600, quota_bytes=10**9, min_free_bytes=0
)


class Publisher:
    """Sends numbers, as fast as the messages of a whole robot."""

    def __init__(self, link: RosLink) -> None:
        self.sent = 0
        self._publish = link.advertise(String, TOPIC, NEWEST)
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._ends.wait(1.0 / RATE_HZ):
            self._publish(String(data=str(self.sent)))
            self.sent += 1

    def close(self) -> None:
        self._ends.set()
        self._thread.join(10.0)


@pytest.mark.ros
@pytest.mark.timing
@pytest.mark.timeout(240)
def test_what_came_while_it_was_stopped_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    prepare_environment(tmp_path / "log")
    settings = RecorderSettings(
        namespace="toy",
        state_directory=tmp_path,
        directory=tmp_path / "runs",
        topics=("*",),
        exclude=(),
        images="jpeg",
        jpeg_quality=85,
        rules=RULES,
        about={},
    )
    child = spawn_recorder(settings, tmp_path / "recorder.log", 0, ())
    answers: list[dict[str, Any]] = []

    def read() -> None:
        assert child.stdout is not None
        with child.stdout:
            for line in child.stdout:
                answers.append(json.loads(line))

    def order(**facts: Any) -> None:
        assert child.stdin is not None
        child.stdin.write(json.dumps(facts).encode() + b"\n")
        child.stdin.flush()

    def status() -> dict[str, Any]:
        return next((answer["status"] for answer in reversed(answers) if "status" in answer), {})

    def received() -> int:
        return int(status().get("received", {}).get(TOPIC, 0))

    reading = threading.Thread(target=read)
    reading.start()
    link = RosLink("publisher")
    link.open()
    publisher = Publisher(link)
    try:
        order(do="start", number=1, name="demo", facts={})
        wait_until(lambda: received() > 100, 60.0)
        os.kill(child.pid, signal.SIGSTOP)
        before = publisher.sent
        wait_until(lambda: publisher.sent > before + FROZEN, 60.0)
        os.kill(child.pid, signal.SIGCONT)
        here = received()
        wait_until(lambda: received() > here + 300, 60.0)  # it hears them again
        publisher.close()
        order(do="stop", number=2, facts={})
        wait_until(lambda: any(answer.get("re") == 2 for answer in answers), 60.0)
        told = next(answer["run"] for answer in answers if answer.get("re") == 2)
        order(do="leave")
        assert child.wait(30) == 0
    finally:
        child.kill()
        child.wait(10)
        publisher.close()
        reading.join(10.0)
        link.close()
        assert child.stdin is not None
        child.stdin.close()
    counts = count_topics(RunStore(tmp_path / "runs").get("latest").files)[TOPIC]
    assert counts.lost is not None
    assert counts.lost > 0
    assert told["missed"] >= counts.lost  # nothing is missed uncounted
    assert counts.messages + counts.lost <= publisher.sent

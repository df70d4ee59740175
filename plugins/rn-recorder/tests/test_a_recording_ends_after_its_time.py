"""A recording for a time ends by itself, once, and a newer one or the end of the server takes the
time back.
"""

from __future__ import annotations

import threading

import pytest

from rn_recorder.tools import RecordingEnds
from roboneuron import StateError

SOON_S, LATE_S = 0.01, 60.0


def test_it_ends_after_its_time() -> None:
    ends, ended = RecordingEnds(), threading.Event()
    runs: list[str] = []
    ends.what = lambda run: (runs.append(run), ended.set())
    ends.after(SOON_S, "run-1")
    assert ended.wait(10.0)
    assert runs == ["run-1"]
    ends.close()


def test_a_newer_recording_replaces_the_time_and_close_takes_it_back() -> None:
    ends = RecordingEnds()
    ends.after(LATE_S, "run-1")
    first = ends._timer
    ends.after(None, "run-2")
    assert first is not None
    assert first.finished.is_set()
    assert ends._timer is None
    ends.after(LATE_S, "run-3")
    ends.close()
    ends.close()
    assert ends._timer is None


def test_a_recorder_that_does_not_obey_is_told_of(caplog: pytest.LogCaptureFixture) -> None:
    def fail(run: str) -> None:
        raise StateError("no recorder")

    ends = RecordingEnds()
    ends.what = fail
    ends._end("run-1")
    assert "run-1 could not be ended" in caplog.text

"""A recording for a time ends by itself, once, and a newer one or the end of the server takes the
time back.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import anyio
import pytest

from rn_recorder.process import RecorderProcess
from rn_recorder.tools import RecordingEnds, StartRecording, StopRecording, recording_tools
from rn_recorder_runs.store import RunStore
from roboneuron import NotReadyError, StateError

SOON_S, LATE_S = 0.01, 60.0


def test_it_ends_after_its_time() -> None:
    ends, ended = RecordingEnds(), threading.Event()
    runs: list[str] = []
    ends.what = runs.append
    ends.told = lambda run: (runs.append(f"told {run}"), ended.set())
    ends.after(SOON_S, "run-1")
    assert ended.wait(10.0)
    assert runs == ["run-1", "told run-1"]
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
    ends.what, ends.told = fail, lambda run: pytest.fail("it goes on")
    ends._end("run-1")
    assert "run-1 could not be ended" in caplog.text


def test_it_is_tried_again_until_the_recorder_answers() -> None:
    ends, ended = RecordingEnds(), threading.Event()
    ends.again_s = SOON_S
    tries: list[str] = []

    def end(run: str) -> None:
        tries.append(run)
        if len(tries) < 3:
            raise NotReadyError("it starts")
        ended.set()

    ends.what = end
    ends.after(SOON_S, "run-1")
    assert ended.wait(10.0)
    assert tries == ["run-1"] * 3
    ends.close()


def test_a_newer_recording_keeps_its_time_when_an_older_one_has_ended(
    ends: RecordingEnds,
) -> None:
    ends.after(LATE_S, "run-2")
    ends.forget("run-1")
    assert ends._timer is not None
    ends.forget("run-2")
    assert ends._timer is None


class Silent:
    """A recorder that does not answer."""

    def __init__(self) -> None:
        self.orders: list[dict[str, Any]] = []
        self.resumed = ["run-2", "run"]

    def ask(self, order: dict[str, Any], timeout_s: float) -> dict[str, Any]:
        self.orders.append(order)
        raise NotReadyError("The recorder has not answered.")

    def resume_with(self, run: str, name: str) -> None:
        self.resumed = [run, name]

    def resume_not(self, run: str) -> None:
        if self.resumed[0] == run:
            self.resumed = ["", ""]


class Context:
    """Runs work at once."""

    simulated = False

    who, role = "ann", "operator"

    async def run(self, work: Callable[[Callable[[str], None]], Any]) -> Any:
        return work(lambda _: None)


@pytest.fixture
def ends() -> Iterator[RecordingEnds]:
    made = RecordingEnds()
    yield made
    made.close()


def test_a_stop_without_an_answer_keeps_the_time(ends: RecordingEnds, tmp_path: Path) -> None:
    process = cast("RecorderProcess", Silent())
    tools = recording_tools(RunStore(tmp_path), lambda: process, True, ends)
    stop = next(tool for tool in tools if tool.name == "stop_recording")
    ends.after(LATE_S, "run-2")
    with pytest.raises(NotReadyError):
        anyio.run(stop.handler, StopRecording(), Context())
    assert ends._timer is not None
    assert not ends._timer.finished.is_set()


def test_the_time_of_an_older_recording_ends_no_newer_one(
    ends: RecordingEnds, tmp_path: Path
) -> None:
    silent = Silent()
    recording_tools(RunStore(tmp_path), lambda: cast("RecorderProcess", silent), True, ends)
    ends._end("run-1")
    assert silent.orders == [{"do": "stop", "run": "run-1", "facts": {}}]
    assert silent.resumed == ["run-2", "run"]


class Obedient(Silent):
    """A recorder that begins and ends `run-3`, and tells when it has ended."""

    def __init__(self) -> None:
        super().__init__()
        self.ended = threading.Event()

    def ask(self, order: dict[str, Any], timeout_s: float) -> dict[str, Any]:
        self.orders.append(order)
        if order["do"] == "stop":
            self.ended.set()
        return {"id": "run-3"}


class Cancelled(Context):
    """A call that is cancelled before or after its work is done."""

    def __init__(self, *, before: bool) -> None:
        self._before = before

    async def run(
        self,
        work: Callable[[Callable[[str], None]], Any],
        *,
        on_cancel: Callable[[], object] = lambda: None,
    ) -> Any:
        if self._before:
            on_cancel()
        work(lambda _: None)
        if not self._before:
            on_cancel()
        raise StateError("cancelled")


@pytest.mark.parametrize("before", [True, False])
def test_a_recording_whose_start_is_cancelled_ends(
    ends: RecordingEnds, tmp_path: Path, before: bool
) -> None:
    recorder = Obedient()
    process = cast("RecorderProcess", recorder)
    start = recording_tools(RunStore(tmp_path), lambda: process, True, ends)[0]
    context: Any = Cancelled(before=before)
    with pytest.raises(StateError, match="cancelled"):
        anyio.run(start.handler, StartRecording(duration_s=LATE_S), context)
    assert recorder.ended.wait(10.0)
    assert recorder.orders[-1]["run"] == "run-3"
    assert recorder.resumed == ["", ""]

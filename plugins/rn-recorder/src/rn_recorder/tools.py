"""The tools: begin, end and label a recording, list what is there."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any, Literal

from pydantic import Field

from rn_recorder.process import RecorderProcess
from rn_recorder_runs.store import Run, RunStore
from roboneuron import (
    Arguments,
    CallContext,
    InvalidInputError,
    NotReadyError,
    Result,
    RoboNeuronError,
    StateError,
    Tool,
)

log = logging.getLogger(__name__)
_ANSWER_S = 10.0
_NAME = r"^[a-z0-9][a-z0-9-]*$"
Outcome = Literal["success", "failure", "unknown"]


class StartRecording(Arguments):
    """Arguments of start_recording."""

    name: str = Field(
        default="run",
        max_length=60,
        pattern=_NAME,
        description="Short name; lower-case letters, digits, hyphens.",
    )
    note: str = Field(default="", max_length=500, description="Kept with the recording.")
    duration_s: float | None = Field(
        default=None,
        gt=0,
        le=86400,
        description="Ends after this time; the call returns at once.",
    )


class StartedRecording(Result):
    """A recording in progress."""

    id: str
    directory: str = Field(description="where it is written, on the server's host")


class StopRecording(Arguments):
    """Arguments of stop_recording."""

    outcome: Outcome = Field(
        default="unknown", description="How it went; data sets are selected by it."
    )
    note: str = Field(default="", max_length=500, description="Kept with the recording.")


class StoppedRecording(Result):
    """A finished recording."""

    id: str
    files: list[str] = Field(description="MCAP files, on the server's host")
    duration_s: float
    size_bytes: int
    lost: int = Field(description="messages that could not be written or came too fast")


class ListRecordings(Arguments):
    """Arguments of list_recordings."""

    entries: int = Field(default=20, ge=1, le=200, description="At most so many, the newest.")


class LabelRecording(Arguments):
    """Arguments of label_recording."""

    run: str = Field(min_length=1, max_length=200, description="Id, as list_recordings gives it.")
    outcome: Outcome | None = Field(default=None, description="How it went; default: as it was.")
    comment: str | None = Field(
        default=None, max_length=500, description="Any text; default: as it was."
    )


class LabelledRecording(Result):
    """The whole label of a recording."""

    id: str
    outcome: str
    comment: str


class RunEntry(Result):
    """A recording or an incident."""

    id: str
    kind: Literal["recording", "incident"]
    begun_at: str = Field(description="ISO 8601; empty when unknown")
    size_bytes: int
    files: int
    state: str = Field(description="recording, finished, interrupted")
    outcome: str
    note: str


class Recordings(Result):
    """Recordings and incidents, newest first, and the recorder's state."""

    recorder: str = Field(description="ok, starting, stalled, ended, or off")
    recording: str = Field(description="id of the recording in progress; empty for none")
    problem: str = Field(description="why nothing is written now; empty when all is well")
    lost: int = Field(
        description="messages that could not be written or came too fast, since the recorder "
        "started; also while nothing was recorded: a recording has its own count"
    )
    restarts: int
    runs: list[RunEntry]
    directory: str


class RecordingEnds:
    """Timer that ends a recording; a newer recording or `close` replaces it."""

    def __init__(self) -> None:
        self.what: Callable[[str], object] = lambda run: None
        """Called with the id of the recording to be ended."""
        self.told: Callable[[str], object] = lambda run: None
        """Called with the id of a recording that was ended."""
        self.again_s = 5.0
        """Time until the next attempt while the recorder does not answer [s]."""
        self._lock = threading.Lock()
        self._timer: threading.Timer | None = None
        self._run = ""

    def after(self, duration_s: float | None, run: str) -> None:
        """End the recording `run` after this time; None for no limit."""
        with self._lock:
            self._cancel()
            self._run = run
            if duration_s is not None:
                self._begin(duration_s)

    def forget(self, run: str) -> None:
        """Cancel the timer of a recording that has ended; one of another recording stays."""
        with self._lock:
            if self._run == run:
                self._cancel()

    def close(self) -> None:
        """Cancel the timer; may be called twice."""
        with self._lock:
            self._cancel()

    def _begin(self, duration_s: float) -> None:
        self._timer = threading.Timer(duration_s, self._end, (self._run,))
        self._timer.daemon = True
        self._timer.start()

    def _cancel(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer, self._run = None, ""

    def _end(self, run: str) -> None:
        try:
            self.what(run)
            self.told(run)
        except NotReadyError as error:
            log.warning("The recording %s could not be ended yet: %s", run, error)
            with self._lock:
                if self._run == run:
                    self._begin(self.again_s)
        except RoboNeuronError as error:
            log.error("The recording %s could not be ended after its time: %s", run, error)


def recording_tools(
    store: RunStore,
    process: Callable[[], RecorderProcess | None],
    is_enabled: bool,
    ends: RecordingEnds,
) -> list[Tool]:
    """Create start_recording, stop_recording and list_recordings."""
    labelling = threading.Lock()  # two pages may label at once

    def recorder() -> RecorderProcess:
        found = process()
        if found is None or not is_enabled:
            raise NotReadyError(
                "The recorder is switched off.", hint="Set enabled = true in [recorder]."
            )
        return found

    def ask(order: dict[str, Any]) -> dict[str, Any]:
        answer = recorder().ask(order, _ANSWER_S)
        if "error" in answer:
            raise StateError(str(answer["error"]), hint=str(answer.get("hint", "")))
        return answer

    def end(run: str) -> None:
        """End a recording whose time is over, but not a newer one."""
        recorder().resume_not(run)
        ask({"do": "stop", "run": run, "facts": {}})

    ends.what = end

    async def start_recording(arguments: StartRecording, context: CallContext) -> StartedRecording:
        facts = {"note": arguments.note, "who": context.who, "outcome": "unknown"}
        order = {"do": "start", "name": arguments.name, "facts": facts}
        begun, halt = list[str](), threading.Event()

        def begin() -> str:
            run = str(ask(order)["id"])
            recorder().resume_with(run, arguments.name)
            begun.append(run)  # before `halt` is read, as `cancel` sets it before it reads this
            ends.after(0.0 if halt.is_set() else arguments.duration_s, run)
            return run

        def cancel() -> None:
            halt.set()
            for run in begun:
                ends.after(0.0, run)

        run = await context.run(lambda _: begin(), on_cancel=cancel)
        return StartedRecording(id=run, directory=str(store.recordings / run))

    async def stop_recording(arguments: StopRecording, context: CallContext) -> StoppedRecording:
        facts: dict[str, object] = {"outcome": arguments.outcome}
        if arguments.note:
            facts["note"] = arguments.note
        recorder().resume_with("", "")
        run = (await context.run(lambda _: ask({"do": "stop", "facts": facts})))["run"]
        ends.forget(run["id"])
        found = await context.run(lambda _: store.get(run["id"]))
        return StoppedRecording(
            id=run["id"],
            files=run["files"],
            duration_s=round((run["ended_ns"] - run["begun_ns"]) / 1e9, 3),
            size_bytes=found.size_bytes,
            lost=int(run["lost_to_disk"]) + int(run["missed"]),
        )

    async def label_recording(arguments: LabelRecording, context: CallContext) -> LabelledRecording:
        if arguments.outcome is None and arguments.comment is None:
            raise InvalidInputError("There is nothing to say.", hint="Give outcome or comment.")

        def label() -> Run:
            with labelling:
                run = store.get(arguments.run)
                store.label(run, outcome=arguments.outcome, comment=arguments.comment)
                return store.get(run.id)

        run = await context.run(lambda _: label())
        return LabelledRecording(id=run.id, **run.told)

    async def list_recordings(arguments: ListRecordings, context: CallContext) -> Recordings:
        runs = await context.run(lambda _: store.runs())
        found = process()
        status = found.status if found is not None else {}
        lost = int(status.get("lost_to_disk", 0)) + int(status.get("dropped", 0))
        return Recordings(
            recorder=found.state if found is not None and is_enabled else "off",
            recording=str(status.get("recording", "")),
            problem=str(status.get("problem", "")),
            lost=lost + sum(status.get("gaps", {}).values()),
            restarts=max(0, found.starts - 1) if found is not None else 0,
            runs=[_entry(run) for run in runs[::-1][: arguments.entries]],
            directory=str(store.directory),
        )

    return [
        Tool(
            name="start_recording",
            title="Begin a recording",
            description=(
                "Record images, actions, states and calls to MCAP files, for duration_s or until "
                "stop_recording. Incidents are recorded without it."
            ),
            arguments=StartRecording,
            result=StartedRecording,
            handler=start_recording,
        ),
        Tool(
            name="stop_recording",
            title="End the recording",
            description="End the recording and label its outcome, for use as data.",
            arguments=StopRecording,
            result=StoppedRecording,
            handler=stop_recording,
            destructive=False,
        ),
        Tool(
            name="label_recording",
            title="Label a recording",
            description=(
                "Say how a finished recording went, as a person has told you. Counts more than "
                "what stop_recording said."
            ),
            arguments=LabelRecording,
            result=LabelledRecording,
            handler=label_recording,
            destructive=False,
            idempotent=True,
            listed=False,
        ),
        Tool(
            name="list_recordings",
            title="What was recorded",
            description="Recordings and incidents on disk, and the recorder's state.",
            arguments=ListRecordings,
            result=Recordings,
            handler=list_recordings,
            read_only=True,
            seldom=True,
            idempotent=True,
        ),
    ]


def _entry(run: Run) -> RunEntry:
    begun_ns = int(run.facts.get("begun_ns") or run.facts.get("at_ns") or 0)
    return RunEntry(
        id=run.id,
        kind=run.kind,
        begun_at=datetime.fromtimestamp(begun_ns / 1e9, UTC).isoformat() if begun_ns else "",
        size_bytes=run.size_bytes,
        files=len(run.files),
        state=str(run.facts.get("state", "finished")),
        outcome=run.told["outcome"],
        note=run.told["comment"],
    )

"""start_all: all starts run side by side, and a failure or a cancellation leaves nothing of the
call.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import pytest

from rn_standard.tasks.starting import ParallelStart, requests_for
from roboneuron.errors import InvalidInputError, NotReadyError, StateError
from roboneuron.modules.settings import MODULE_KINDS
from roboneuron.selection.requests import StartChosenInference
from roboneuron.server.loop import ClosedLoop

BOUND_S = 10.0


@dataclass
class FakeView:
    kind: str
    phase: str


@dataclass
class FakeSelection:
    kind: str


class FakeLoop:
    """A closed loop that is its own modules and configuration; `begin` decides how each start
    goes.
    """

    def __init__(self, configured: tuple[str, ...] = tuple(MODULE_KINDS)) -> None:
        self.config = self
        self.emergency_stop = self
        self.namespace = "gantry"
        self.prepared: list[str] = []
        self.module_kinds = configured
        self.slots = self.phases = dict.fromkeys(MODULE_KINDS, "stopped")
        self.halt = threading.Event()
        self.stopped: list[str] = []
        self.begin: Callable[[str], None] = lambda kind: None
        self.refuses = ""

    def prepare(self, namespace: str) -> None:
        assert "starting" not in self.phases.values()
        self.prepared.append(namespace)

    def stream(self, namespace: str) -> None:
        assert "starting" not in self.phases.values()

    def view(self, kind: str) -> FakeView:
        return FakeView(kind, self.phases[kind])

    def select(self, kind: str, request: Any, role: str) -> FakeSelection:
        if kind == self.refuses:
            raise InvalidInputError(f"{kind} is refused")
        return FakeSelection(kind)

    def start_selected(
        self, selection: FakeSelection, on_stage: Any, halt: threading.Event
    ) -> None:
        self.halt = halt
        self.phases[selection.kind] = "starting"
        try:
            self.begin(selection.kind)
        except NotReadyError:
            self.phases[selection.kind] = "stopped"
            raise
        if halt.is_set():
            self.phases[selection.kind] = "stopped"
            raise StateError(f"The start of {selection.kind} was cancelled.")
        self.phases[selection.kind] = "running"

    def stop(self, kind: str) -> None:
        self.stopped.append(kind)
        self.phases[kind] = "stopped"


def start_of(loop: FakeLoop, **requests: Any) -> ParallelStart:
    return ParallelStart(cast(ClosedLoop, loop), cast(Any, loop), cast(Any, requests), "operator")


def test_all_modules_are_starting_at_the_same_time() -> None:
    loop = FakeLoop()
    together = threading.Barrier(len(MODULE_KINDS))
    loop.begin = lambda kind: cast(None, together.wait(BOUND_S))  # breaks unless all four are here
    done = start_of(loop).run(lambda text: None)
    assert [view.phase for view in done.views] == ["running"] * 4
    assert done.already == ()


def test_what_runs_already_and_what_is_not_configured_is_left_alone() -> None:
    loop = FakeLoop(configured=("robot", "control"))
    loop.phases["robot"] = "running"
    done = start_of(loop).run(lambda text: None)
    assert [view.kind for view in done.views] == ["control"]
    assert done.already == ("robot",)


def test_a_second_start_says_that_all_runs() -> None:
    loop = FakeLoop()
    loop.phases = loop.slots = dict.fromkeys(MODULE_KINDS, "running")
    done = start_of(loop).run(lambda text: None)
    assert (done.views, done.already) == ((), MODULE_KINDS)
    with pytest.raises(StateError, match="runs already") as caught:
        start_of(loop, inference=StartChosenInference(instruction="go", options={})).run(
            lambda text: None
        )
    assert "set_instruction" in caught.value.hint


def test_a_failure_of_one_cancels_the_others_and_stops_what_had_started() -> None:
    loop = FakeLoop()
    perception_begins = threading.Event()

    def begin(kind: str) -> None:
        if kind == "inference":
            assert perception_begins.wait(BOUND_S)
            deadline_s = time.monotonic() + BOUND_S
            while [loop.phases["robot"], loop.phases["control"]] != [
                "running"
            ] * 2 and time.monotonic() < deadline_s:
                time.sleep(0.001)
            raise NotReadyError("no weights")
        if kind == "perception":  # still starting when inference fails
            perception_begins.set()
            assert loop.halt.wait(BOUND_S)

    loop.begin = begin
    with pytest.raises(NotReadyError, match="no weights"):
        start_of(loop).run(lambda text: None)
    assert set(loop.phases.values()) == {"stopped"}
    assert set(loop.stopped) == {"robot", "control"}


def test_what_is_refused_beforehand_starts_nothing() -> None:
    loop = FakeLoop()
    loop.refuses = "control"
    loop.begin = lambda kind: pytest.fail("nothing may be started")
    with pytest.raises(InvalidInputError):
        start_of(loop).run(lambda text: None)


def test_a_cancelled_call_leaves_nothing() -> None:
    loop = FakeLoop()
    start = start_of(loop)

    def begin(kind: str) -> None:
        if kind == "robot":
            start.cancel()
        assert loop.halt.wait(BOUND_S)

    loop.begin = begin
    with pytest.raises(StateError, match="cancelled"):
        start.run(lambda text: None)
    assert set(loop.phases.values()) == {"stopped"}


@pytest.mark.parametrize("phase", ["starting", "stopping"])
def test_a_start_of_somebody_else_is_not_disturbed(phase: str) -> None:
    loop = FakeLoop()
    loop.phases["perception"] = phase
    with pytest.raises(StateError, match="perception is"):
        start_of(loop).run(lambda text: None)
    assert not loop.halt.is_set()


def test_an_instruction_goes_to_the_named_model() -> None:
    request = requests_for("pick up the red cube", StartChosenInference(model="vla", options={}))[
        "inference"
    ]
    assert isinstance(request, StartChosenInference)
    assert (request.model, request.instruction) == ("vla", "pick up the red cube")
    assert requests_for(None) == {}

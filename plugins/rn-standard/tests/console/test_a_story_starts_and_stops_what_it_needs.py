"""What a run calls on a server, in which order, what it leaves running and which verdict it gives:
with a server that is none.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from typing import Any

import anyio
import pytest
from rich.console import Console

from rn_standard.console.screen import CommandScreen
from rn_standard.console.session import ConsoleSession
from rn_standard.console.status import ServerStatus
from rn_standard.console.story import RunStatus, Story
from roboneuron.errors import NotReadyError, RefusedError


class FakeSession(ConsoleSession):
    """Starts and stops modules in a table; run_task starts the policy, and ends with `outcome`."""

    def __init__(
        self,
        running: tuple[str, ...] = (),
        fails: str = "",
        latched: bool = False,
        outcome: str = "succeeded",
    ) -> None:
        self.running = dict.fromkeys(running, "ok")
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.fails = fails
        self.latched = latched
        self.outcome = outcome

    async def call(
        self,
        tool: str,
        arguments: Mapping[str, Any] | None = None,
        on_progress: Callable[[str], None] | None = None,
        timeout_s: float = 0.0,
    ) -> dict[str, Any]:
        self.calls.append((tool, dict(arguments or {})))
        if on_progress is not None:
            on_progress("robot: activating")
        if tool == self.fails:
            raise NotReadyError(f"{tool} failed.")
        if tool == "run_task":
            self.running["inference"] = "ok"
            return {"outcome": self.outcome, "reason": "it waved\x1b[2J."}
        verb, _, kind = tool.partition("_")
        if verb == "start":
            self.running[kind] = "ok"
        elif verb == "stop":
            del self.running[kind]
        return {}

    async def status(self) -> ServerStatus:
        modules = [
            {"module": kind, "health": health, "pid": 7} for kind, health in self.running.items()
        ]
        return ServerStatus.from_answer(
            {"modules": modules, "emergency_stop": self.latched}, "fake"
        )


def play(session: FakeSession, is_quiet: bool = False) -> tuple[tuple[RunStatus, str], str]:
    output = io.StringIO()
    screen = CommandScreen(Console(file=output, width=200, highlight=False, markup=False), is_quiet)

    async def run() -> tuple[RunStatus, str]:
        story = Story(session, TASK, screen)
        try:
            return await story.play()
        finally:
            await story.stop()

    return anyio.run(run), output.getvalue()


def names(session: FakeSession) -> list[str]:
    return [tool for tool, _ in session.calls]


TASK = {"instruction": "wave", "max_s": 60.0}
STARTS = ["start_robot", "start_perception", "start_control", "run_task"]
STOPS = ["stop_inference", "stop_control", "stop_perception", "stop_robot"]


def test_everything_is_started_in_order_and_stopped_in_the_reverse_order() -> None:
    session = FakeSession()
    verdict, text = play(session)
    assert verdict[0] is RunStatus.DONE
    assert names(session) == [*STARTS, *STOPS]
    assert session.calls[3] == ("run_task", TASK)
    assert [line.split("  ")[1] for line in text.splitlines()][:2] == [
        "✓ start robot",
        "✓ start perception",
    ]
    assert "robot: activating" in text


def test_what_ran_before_goes_on() -> None:
    session = FakeSession(running=("robot", "perception", "inference"))
    play(session)
    assert names(session) == ["start_control", "run_task", "stop_control"]
    assert set(session.running) == {"robot", "perception", "inference"}


@pytest.mark.parametrize(
    ("outcome", "status"),
    [
        ("succeeded", 0),
        ("failed", 1),
        ("timed_out", 1),
        ("stopped", 1),
        ("taken_over", 1),
        ("unclear", 3),
    ],
)
def test_the_verdict_is_that_of_run_task(outcome: str, status: int) -> None:
    (told, words), _ = play(FakeSession(outcome=outcome))
    assert int(told) == status
    assert words.startswith(f"{outcome}: it waved")
    assert words.isprintable()


def test_a_failed_start_stops_what_was_started() -> None:
    session = FakeSession(fails="start_control")
    with pytest.raises(NotReadyError, match=r"start_control failed\."):
        play(session)
    assert names(session) == [*STARTS[:3], "stop_perception", "stop_robot"]
    assert session.running == {}


def test_a_failed_stop_is_shown_and_does_not_hide_the_verdict() -> None:
    session = FakeSession(fails="stop_control")
    verdict, text = play(session)
    assert verdict[0] is RunStatus.DONE
    assert "stop_control failed." in text
    assert set(session.running) == {"control"}


def test_nothing_is_started_while_the_emergency_stop_is_latched() -> None:
    session = FakeSession(latched=True)
    with pytest.raises(RefusedError, match="estop --reset"):
        play(session)
    assert session.calls == []


def test_quiet_shows_no_steps() -> None:
    assert play(FakeSession(), is_quiet=True)[1] == ""

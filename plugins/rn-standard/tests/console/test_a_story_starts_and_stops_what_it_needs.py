"""What a run calls on a server, in which order, and what it leaves running: with a server that is
none.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from typing import Any

import anyio
import pytest
from rich.console import Console

from rn_standard.console import story as story_module
from rn_standard.console.judge import RunEnd, RunOutcome
from rn_standard.console.screen import CommandScreen
from rn_standard.console.session import ConsoleSession
from rn_standard.console.status import ServerStatus
from rn_standard.console.story import Story
from roboneuron.errors import NotReadyError, RefusedError


class FakeSession(ConsoleSession):
    """Starts and stops modules in a table; `notes` are what the backend says, status after
    status.
    """

    def __init__(
        self, running: tuple[str, ...] = (), fails: str = "", latched: bool = False
    ) -> None:
        self.running = dict.fromkeys(running, "ok")
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.fails = fails
        self.latched = latched
        self.looks = 0

    async def call(
        self,
        tool: str,
        arguments: Mapping[str, Any] | None = None,
        on_progress: Callable[[str], None] | None = None,
    ) -> dict[str, Any]:
        self.calls.append((tool, dict(arguments or {})))
        if on_progress is not None:
            on_progress("robot: activating")
        if tool == self.fails:
            raise NotReadyError(f"{tool} failed.")
        verb, _, kind = tool.partition("_")
        if verb == "start":
            self.running[kind] = "ok"
        elif verb == "stop":
            del self.running[kind]
        return {}

    async def status(self) -> ServerStatus:
        self.looks += 1
        done = {"done": "1.0" if self.looks > 4 else "0.0"}
        modules = [
            {
                "module": kind,
                "health": health,
                "pid": 7,
                "metrics": done,
                "note": f"step {self.looks // 3}",
            }
            for kind, health in self.running.items()
        ]
        return ServerStatus.from_answer(
            {"modules": modules, "emergency_stop": self.latched}, "fake"
        )


@pytest.fixture(autouse=True)
def _fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(story_module, "_LOOK_PERIOD_S", 0.0)


def play(session: FakeSession, is_quiet: bool = False) -> tuple[RunEnd, str]:
    output = io.StringIO()
    screen = CommandScreen(Console(file=output, width=200, highlight=False, markup=False), is_quiet)

    async def run() -> RunEnd:
        story = Story(session, "wave", 60.0, screen)
        try:
            return await story.play()
        finally:
            await story.stop()

    return anyio.run(run), output.getvalue()


def names(session: FakeSession) -> list[str]:
    return [tool for tool, _ in session.calls]


STARTS = ["start_robot", "start_perception", "start_control", "start_inference"]
STOPS = ["stop_inference", "stop_control", "stop_perception", "stop_robot"]


def test_everything_is_started_in_order_and_stopped_in_the_reverse_order() -> None:
    session = FakeSession()
    verdict, text = play(session)
    assert verdict.outcome is RunOutcome.DONE
    assert names(session) == [*STARTS, *STOPS]
    assert session.calls[3] == ("start_inference", {"instruction": "wave"})
    assert [line.split("  ")[1] for line in text.splitlines()][:2] == [
        "✓ start robot",
        "✓ start perception",
    ]
    assert "step 1" in text


def test_what_ran_before_goes_on_but_for_the_backend() -> None:
    session = FakeSession(running=("robot", "perception", "inference"))
    play(session)
    assert names(session) == ["start_control", "set_instruction", "stop_inference", "stop_control"]
    assert set(session.running) == {"robot", "perception"}


def test_a_failed_start_stops_what_was_started() -> None:
    session = FakeSession(fails="start_control")
    with pytest.raises(NotReadyError, match=r"start_control failed\."):
        play(session)
    assert names(session) == [*STARTS[:3], "stop_perception", "stop_robot"]
    assert session.running == {}


def test_a_failed_stop_is_shown_and_does_not_hide_the_verdict() -> None:
    verdict, text = play(FakeSession(fails="stop_control"))
    assert verdict.outcome is RunOutcome.DONE
    assert "stop_control failed." in text


def test_nothing_is_started_while_the_emergency_stop_is_latched() -> None:
    session = FakeSession(latched=True)
    with pytest.raises(RefusedError, match="estop --reset"):
        play(session)
    assert session.calls == []


def test_quiet_shows_no_steps() -> None:
    assert play(FakeSession(), is_quiet=True)[1] == ""

"""One run: start missing modules, have the server carry out the task, stop the started modules."""

from __future__ import annotations

import signal
import time
from argparse import Namespace
from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import anyio
from anyio.abc import TaskStatus
from mcp.shared.exceptions import MCPError

from rn_standard.console import connection
from rn_standard.console.screen import CommandScreen
from rn_standard.console.session import ConsoleSession
from roboneuron import NotReadyError, RefusedError, foreign

_STOP_S = 60.0
_LONGEST_S = 20 * 86400.0
"""Longest wait for a task's end: the most attempts of the longest duration."""
_KINDS = ("robot", "perception", "control")
_MOST_TEXT = 1000


class RunStatus(IntEnum):
    """Exit status of a run."""

    DONE = 0
    NOT_DONE = 1
    UNKNOWN = 3
    INTERRUPTED = 130


STATUSES = {"succeeded": RunStatus.DONE, "unclear": RunStatus.UNKNOWN}
"""Exit status by the outcome of run_task; not done for every other one."""


async def run_instruction(arguments: Namespace, screen: CommandScreen) -> int:
    """Perform the run; return the exit status. Raises as `connection.connect`, and NotReadyError
    for a failed start or task.
    """
    task = {
        "instruction": arguments.instruction,
        "until": arguments.until,
        "max_s": arguments.max_s,
        "max_attempts": arguments.max_attempts,
    }
    given = {name: value for name, value in task.items() if value is not None}
    async with connection.connect(arguments) as client:
        session = ConsoleSession(client, arguments.url or "a server of its own")
        story = Story(session, given, screen)
        status, told = RunStatus.INTERRUPTED, "interrupted, stopped"
        try:
            async with anyio.create_task_group() as group:
                await group.start(_cancel_when_interrupted, group.cancel_scope)
                status, told = await story.play()
                group.cancel_scope.cancel()
        finally:
            with anyio.CancelScope(shield=True), anyio.move_on_after(_STOP_S):
                await story.stop()
    screen.end(status is RunStatus.DONE, told)
    return int(status)


async def _cancel_when_interrupted(
    scope: anyio.CancelScope, *, task_status: TaskStatus[None]
) -> None:
    """Cancel the run on Ctrl-C or SIGTERM, so that everything is stopped in order."""
    with anyio.open_signal_receiver(signal.SIGINT, signal.SIGTERM) as signals:
        task_status.started()
        async for _ in signals:
            scope.cancel()
            return


class Story:
    """The steps of a run.

    Args:
        session: of the server.
        task: arguments of run_task.
        screen: shows the steps.
    """

    def __init__(
        self, session: ConsoleSession, task: Mapping[str, Any], screen: CommandScreen
    ) -> None:
        self._session = session
        self._task = task
        self._screen = screen
        self._started: list[str] = []

    async def play(self) -> tuple[RunStatus, str]:
        """Perform all steps but the stop; return the verdict and its words.

        Raises:
            RefusedError: the emergency stop is latched.
            NotReadyError: a start failed, or the task could not begin.
        """
        status = await self._session.status()
        if status.emergency_stop:
            cause = f" by {status.emergency_stop_cause}" if status.emergency_stop_cause else ""
            raise RefusedError(
                f"The emergency stop is latched{cause}.",
                hint="Look at the robot, then `roboneuron estop --reset`.",
                rule="emergency_stop",
            )
        for kind in _KINDS:
            if status.module(kind) is None:
                self._started.append(kind)
                with self._screen.step(f"start {kind}") as update:
                    await self._session.call(f"start_{kind}", on_progress=update)
        if status.module("inference") is None:  # run_task starts it
            self._started.append("inference")
        began_s = time.monotonic()
        with self._screen.live("carry out the task | Ctrl-C stops") as update:

            def show(text: str) -> None:
                line = foreign.printable(text, _MOST_TEXT)
                self._screen.say(f"{time.monotonic() - began_s:5.1f} s  {line}")
                update(f"{line} | Ctrl-C stops")

            end = await self._session.call(
                "run_task", self._task, on_progress=show, timeout_s=_LONGEST_S
            )
        outcome = str(end["outcome"])
        reason = foreign.printable(str(end["reason"]), _MOST_TEXT)
        return STATUSES.get(outcome, RunStatus.NOT_DONE), f"{outcome}: {reason}"

    async def stop(self) -> None:
        """Stop the modules started by this run, newest first; a failure is shown, and the others
        are stopped all the same.
        """
        try:
            there = {module.module for module in (await self._session.status()).running}
        except (NotReadyError, MCPError):  # the server has ended, and its modules with it
            return
        kinds = [kind for kind in reversed(self._started) if kind in there]
        if not kinds:
            return
        with self._screen.step(f"stop {', '.join(kinds)}"):
            for kind in kinds:
                try:
                    await self._session.call(f"stop_{kind}")
                except (NotReadyError, MCPError) as error:
                    self._screen.warn(str(error))

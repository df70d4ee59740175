"""One run: start missing modules, give the instruction, monitor until the end, stop the started
modules.
"""

from __future__ import annotations

import signal
import time
from argparse import Namespace

import anyio
from anyio.abc import TaskStatus
from mcp.shared.exceptions import MCPError

from rn_standard.console import connection
from rn_standard.console.judge import RunEnd, RunJudge, RunOutcome
from rn_standard.console.screen import CommandScreen
from rn_standard.console.session import ConsoleSession
from rn_standard.console.status import ReportedModule, ServerStatus
from rn_standard.console.table import fault_text
from roboneuron import NotReadyError, RefusedError

_LOOK_PERIOD_S = 0.25
_STOP_S = 60.0
_KINDS = ("robot", "perception", "control", "inference")


async def run_instruction(arguments: Namespace, screen: CommandScreen) -> int:
    """Perform the run; return the exit status. Raises as `connection.connect`, and NotReadyError
    for a failed start.
    """
    async with connection.connect(arguments) as client:
        session = ConsoleSession(client, arguments.url or "a server of its own")
        story = Story(session, arguments.instruction, arguments.timeout_s, screen)
        verdict = RunEnd(outcome=RunOutcome.INTERRUPTED, reason="interrupted")
        try:
            async with anyio.create_task_group() as group:
                await group.start(_cancel_when_interrupted, group.cancel_scope)
                verdict = await story.play()
                group.cancel_scope.cancel()
        finally:
            with anyio.CancelScope(shield=True), anyio.move_on_after(_STOP_S):
                await story.stop()
    words = {RunOutcome.DONE: "done", RunOutcome.NOT_DONE: "not done", RunOutcome.UNKNOWN: "ended"}
    head = words.get(verdict.outcome)
    screen.end(
        verdict.outcome is RunOutcome.DONE,
        f"{head}: {verdict.reason}" if head else f"{verdict.reason}, stopped",
    )
    return int(verdict.outcome)


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
    """The steps of a run."""

    def __init__(
        self, session: ConsoleSession, instruction: str, timeout_s: float, screen: CommandScreen
    ) -> None:
        self._session = session
        self._instruction = instruction
        self._screen = screen
        self._judge = RunJudge(instruction, timeout_s)
        self._started: list[str] = []

    async def play(self) -> RunEnd:
        """Perform all steps but the stop.

        Raises:
            RefusedError: the emergency stop is latched.
            NotReadyError: a start failed, or the backend cannot act on the instruction.
        """
        status = await self._session.status()
        if status.emergency_stop:
            cause = f" by {status.emergency_stop_cause}" if status.emergency_stop_cause else ""
            raise RefusedError(
                f"The emergency stop is latched{cause}.",
                hint="Look at the robot, then `roboneuron estop --reset`.",
                rule="emergency_stop",
            )
        for kind in _KINDS[:-1]:
            if status.module(kind) is None:
                self._started.append(kind)
                with self._screen.step(f"start {kind}") as update:
                    await self._session.call(f"start_{kind}", on_progress=update)
        is_running = status.module("inference") is not None
        tool = "set_instruction" if is_running else "start_inference"
        # stopped in any case, because the robot is unattended afterwards
        self._started.append("inference")
        with self._screen.step(
            "give the instruction" if is_running else "start inference"
        ) as update:
            await self._session.call(tool, {"instruction": self._instruction}, on_progress=update)
        return await self._watch()

    async def _watch(self) -> RunEnd:
        started_s = time.monotonic()
        note = ""
        health: dict[str, str] = {}
        with self._screen.live("") as update:
            while True:
                status = await self._session.status()
                elapsed_s = time.monotonic() - started_s
                for module in status.running:
                    if health.get(module.module, "ok") != module.health:
                        self._tell_health(module)
                    health[module.module] = module.health
                inference = status.module("inference")
                if inference is not None and inference.note and inference.note != note:
                    note = inference.note
                    self._screen.say(f"{elapsed_s:5.1f} s  {note}")
                if (verdict := self._judge.look(status, elapsed_s)) is not None:
                    return verdict
                update(self._now(status, elapsed_s, note))
                await anyio.sleep(_LOOK_PERIOD_S)

    def _tell_health(self, module: ReportedModule) -> None:
        if module.is_faulty:
            self._screen.warn(f"{module.module}: {fault_text(module)}")
        elif module.health == "ok":
            self._screen.say(f"{module.module} works again")

    def _now(self, status: ServerStatus, elapsed_s: float, note: str) -> str:
        words = [f"{elapsed_s:.0f} s", note or "moving"]
        inference = status.module("inference")
        if inference is not None and inference.rate_hz is not None:
            words.append(f"{inference.rate_hz:.0f} actions/s")
        if (target := self._judge.target(status)) is not None:
            words.append(f"{target[0]} lifted by {max(0.0, target[1].lifted_m) * 100:.0f} cm")
        return " | ".join([*words, "Ctrl-C stops"])

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
        try:
            with self._screen.step(f"stop {', '.join(kinds)}"):
                for kind in kinds:
                    await self._session.call(f"stop_{kind}")
        except (NotReadyError, MCPError) as error:
            self._screen.warn(str(error))

"""A served arm, one of whose processes hangs, for `hang_matrix`."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import psutil
from hang_parts import (
    ENDED_S,
    NEVER,
    REST_S,
    STOPPED_S,
    TOLD,
    Hangs,
    HungClient,
    alive,
    press,
    release,
    until,
    whole,
    words,
)
from lost_cell import KINDS, Witness

SETTLED_S = 8.0
"""Start of a recorder on a busy machine."""


class Arm:
    """A served arm, started anew when its server has ended."""

    def __init__(self, folder: Path, hangs: Hangs, environment: dict[str, str]) -> None:
        from roboneuron.ros.link import RosLink  # heavy

        self.folder, self.hangs, self._environment = folder, hangs, environment
        self.link = RosLink("witness")
        self.link.open()
        self.witness = Witness(self.link, "fr3")
        self.client: HungClient | None = None

    def served(self) -> HungClient:
        if self.client is None or not alive(self.client.process.pid):
            if self.client is not None:
                self.client.close()
            self.client = HungClient(self.folder, self._environment)
            self.client.begin()
        return self.client

    def end(self) -> None:
        if self.client is not None:
            self.client.close()
            self.client = None

    def moving(self) -> HungClient:
        client = self.served()
        client.run_all()
        arguments = {"instruction": "pick up the red cube", "until": NEVER, "max_s": 60}

        def task() -> None:
            with contextlib.suppress(TimeoutError, OSError, ValueError):
                client.ask("run_task", **arguments)

        threading.Thread(target=task, daemon=True).start()
        until(self.witness.moves, 60.0, "a motion")
        time.sleep(0.2)
        return client

    def last_motion_s(self, since_s: float) -> float:
        """Time of the last motion after `since_s`, relative to it [s]."""
        moves = [
            at for at, _, speed in self.witness.states if at > since_s and abs(speed).max() > 0.02
        ]
        return max(moves, default=since_s) - since_s

    def children(self) -> set[int]:
        if self.client is None:
            return set()
        with contextlib.suppress(psutil.NoSuchProcess):
            return {child.pid for child in self.client.process.children(recursive=True)}
        return set()

    def trial(self, process: str, phase: str, told: str) -> dict[str, Any]:
        problems: list[str] = []
        starting: threading.Thread | None = None
        if process == "server":
            client = self._server(phase)
            pid, parent = client.process.pid, client.parent.pid
        else:
            client = self.moving() if phase == "motion" or process == "recorder" else self.served()
            parent = client.process.pid
            pid, starting = self._pid(client, process, phase)
        family = {pid} | (
            self.children() if process == "server" or told in ("parent", "stdin") else set()
        )
        hung_s = self.hangs.hang(pid)

        def close() -> None:  # of a module, only its server's end closes it
            if process == "server":
                client.parent.stdin.close()  # type: ignore[union-attr]
            else:
                os.kill(parent, signal.SIGKILL)

        self.hangs.tell(pid, told, parent, close)
        ends: dict[str, Any] = {}
        pressed_s = press(self.folder, self._environment) if told == "estop" else 0.0
        try:
            until(lambda: not alive(pid), ENDED_S, "the end")
            ends["ended_s"] = round(time.monotonic() - hung_s, 2)
            until(lambda: not any(map(alive, family)), ENDED_S, "the end of what it has started")
            ends["all_s"] = round(time.monotonic() - hung_s, 2)
        except TimeoutError as error:
            problems.append(f"{error}: {[p for p in family if alive(p)]}")
            for left in family:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(left, signal.SIGKILL)
        if starting is not None:
            starting.join(60.0)
        time.sleep(max(0.0, hung_s + REST_S + 0.5 - time.monotonic()))
        if phase == "motion" and (process != "recorder" or told in ("stdin", "parent")):
            ends["rest_s"] = round(self.last_motion_s(hung_s), 2)
            if ends["rest_s"] > REST_S:
                problems.append(f"the arm moved for {ends['rest_s']} s")
        if told == "estop":
            ends["stopped_s"] = round(self.last_motion_s(pressed_s), 2)
            if process == "server" and ends["stopped_s"] > STOPPED_S:
                problems.append(f"the arm moved for {ends['stopped_s']} s after the stop")
            release(self.folder)
        if process in KINDS and told in TOLD[:4] and phase == "motion":
            client = self.served()
            until(lambda: client.modules()[process]["phase"] != "running", 10.0, "its exit")
            module = client.modules()[process]
            text = json.dumps(module)
            # the end of a task may have stopped the module before it ended by itself
            if module["phase"] == "exited" and "its interpreter hung" not in text:
                problems.append(f"the status does not name the hang: {text[:300]}")
        problems += whole(self.folder / "state")
        try:
            self.served().run_all()
        except (RuntimeError, TimeoutError, OSError) as error:
            problems.append(f"the next start: {error}")
            self.end()
        return {"process": process, "phase": phase, "told": told, **ends, "problems": problems}

    def _server(self, phase: str) -> HungClient:
        if phase == "motion":
            return self.moving()
        self.end()
        self.client = HungClient(self.folder, self._environment)
        time.sleep(0.3)
        return self.client

    def _pid(
        self, client: HungClient, process: str, phase: str
    ) -> tuple[int, threading.Thread | None]:
        if process == "recorder":
            pid = until(lambda: self.child("rn_recorder_runs"), 30.0, "the recorder")
            if phase == "motion":
                time.sleep(SETTLED_S)
            return pid, None
        if phase == "motion":
            return int(client.modules()[process]["pid"]), None
        client.run_all()
        client.ask(f"stop_{process}")
        known = self.children()

        def start() -> None:
            with contextlib.suppress(TimeoutError, OSError, ValueError):
                client.ask(f"start_{process}")

        thread = threading.Thread(target=start, daemon=True)
        thread.start()
        pid = until(
            lambda: next(
                (p for p in self.children() - known if "roboneuron.modules" in words(p)), 0
            ),
            30.0,
            "the process",
        )
        time.sleep(0.5)
        return pid, thread

    def child(self, module: str) -> int:
        return next((p for p in self.children() if module in words(p)), 0)

"""The recorder's process, controlled by the server: orders through a bounded queue, answers,
restarts.

Only the tools that query the recorder wait for it, and those for a bounded time.
"""

from __future__ import annotations

import json
import logging
import os
import queue
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from rn_recorder_runs.line_pipe import parse_line
from roboneuron import NotReadyError

log = logging.getLogger(__name__)
MOST_ORDERS = 2000
STALLED_S = 10.0
"""Time without a status (it comes every 0.5 s) after which the recorder is restarted."""
STARTING_S = 60.0
"""Time allowed until its first status: it imports ROS and joins, on a machine that is busy with
other starts.
"""
VALID_SHARE = 0.75
"""Share of a caller's waiting time in which the recorder may begin to obey; the rest is for the
answer.
"""
_LEAVE_S = 4.0
_BACKOFF_S = (0.5, 2.0, 5.0, 15.0, 30.0)
_STEADY_S = 60.0
"""Run time after which a recorder may be restarted at once."""
Spawn = Callable[[int, str, str], "subprocess.Popen[bytes]"]


class RecorderProcess:
    """Keeps one recorder running until `close`. Every method may be called from any thread.

    Args:
        spawn: starts one; called with the number of earlier ones, and id and name of a recording to
            continue.
        observe: called with the pid of an ended one.
    """

    def __init__(self, spawn: Spawn, observe: Callable[[int], object] = lambda pid: None) -> None:
        self._spawn = spawn
        self._observe = observe
        # bounded by `_put`, because `queue.Queue` takes Python locks on the calling thread
        self._orders: queue.SimpleQueue[dict[str, object]] = queue.SimpleQueue()
        self._answers: dict[int, dict[str, Any]] = {}
        self._awaited: set[int] = set()
        """Numbers of the orders whose callers still wait; guarded by `_changed`."""
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._child: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None
        self._number = 0
        self._told_s = 0.0
        self._resume = ("", "")
        self.status: dict[str, Any] = {}
        self.starts = 0
        self.ends = 0
        self.dropped = 0
        self.broken = 0
        """Number of lines of recorders that are no answer."""

    @property
    def pid(self) -> int | None:
        """Pid of the running process."""
        child = self._child
        return child.pid if child is not None and child.poll() is None else None

    @property
    def state(self) -> str:
        """State as one word: off, starting, ok, stalled, ended."""
        if self._thread is None:
            return "off"
        if self.pid is None:
            return "ended" if self.starts else "starting"
        if not self.status:
            return "starting"
        return "stalled" if time.monotonic() - self._told_s > 2.0 else "ok"

    def start(self) -> None:
        """Start; does nothing the second time."""
        if self._thread is None and not self._closing.is_set():
            self._thread = threading.Thread(target=self._keep, name="recorder", daemon=True)
            self._thread.start()

    def note(self, what: str, facts: Mapping[str, object], incident: str = "") -> None:
        """Send an event; never blocks: an event that does not fit into the queue is dropped and
        counted.
        """
        order = {
            "do": "event",
            "what": what,
            "at_ns": time.time_ns(),
            "facts": dict(facts),
            "incident": incident,
        }
        if not self._put(order):
            self.dropped += 1

    def _put(self, order: dict[str, object]) -> bool:
        """Queue an order unless there are too many; concurrent threads may exceed the bound by one
        each.
        """
        has_room = self._orders.qsize() < MOST_ORDERS
        if has_room:
            self._orders.put(order)
        return has_room

    def ask(self, order: Mapping[str, object], timeout_s: float) -> dict[str, Any]:
        """Send an order and return the answer. An order without an answer in time is not executed
        later.

        Raises:
            NotReadyError: it does not run, ended meanwhile, sent a broken line, or did not answer
                in time.
        """
        with self._changed:
            self._number += 1
            number, before = self._number, (self.ends, self.broken)
            self._awaited.add(number)
        # the recorder has the same monotonic clock, because it runs on this machine
        until_s = time.monotonic() + VALID_SHARE * timeout_s
        try:
            if not self._put({**order, "number": number, "until_s": until_s}):
                raise NotReadyError(
                    "The recorder takes no orders.", hint="list_recordings tells how it is."
                )
            return self._answer_to(number, before, timeout_s)
        finally:
            with self._changed:
                self._awaited.discard(number)
                self._answers.pop(number, None)

    def _answer_to(self, number: int, before: tuple[int, int], timeout_s: float) -> dict[str, Any]:
        """Wait for the answer to an order that was given after that many ends and broken lines.
        Raises NotReadyError as `ask`.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: number in self._answers or (self.ends, self.broken) != before, timeout_s
            )
            if number not in self._answers and self.ends > before[0]:
                raise NotReadyError(
                    "The recorder ended before it answered.",
                    hint="It is started again: call again.",
                )
            if number not in self._answers and self.broken > before[1]:
                raise NotReadyError(
                    "A line of the recorder could not be read; it may have been the answer.",
                    hint="list_recordings tells what is recorded now; the server's log has the "
                    "line.",
                )
            if number not in self._answers:
                raise NotReadyError(
                    f"The recorder has not answered within {timeout_s:g} s; it is {self.state}.",
                    hint="list_recordings tells how it is; its log is recorder.log beside the "
                    "modules' logs.",
                )
            return self._answers[number]

    def wait_for_status(self) -> bool:
        """Wait for the next status of a running recorder; return True if there was one before
        `close`.
        """
        with self._changed:
            before_s = self._told_s
            self._changed.wait_for(
                lambda: self._closing.is_set() or (bool(self.status) and self._told_s > before_s)
            )
        return not self._closing.is_set()

    def resume_with(self, run_id: str, name: str) -> None:
        """Set the recording that the next process continues if this one dies; empty for none."""
        self._resume = (run_id, name)

    def resume_not(self, run_id: str) -> None:
        """Do not continue this recording; another one is still continued."""
        if self._resume[0] == run_id:
            self._resume = ("", "")

    def close(self) -> None:
        """Wait a bounded time for it to finish its files; idempotent."""
        self._closing.set()
        with self._changed:
            self._changed.notify_all()
        child, thread = self._child, self._thread
        if child is not None and child.poll() is None:
            self._put({"do": "leave"})
            try:
                child.wait(_LEAVE_S)
            except subprocess.TimeoutExpired:
                self._kill(child)
        if thread is not None:
            thread.join(2.0)

    def _keep(self) -> None:
        """Start the process, and restart it whenever it ends."""
        while not self._closing.is_set():
            begun_s = time.monotonic()
            try:
                child = self._spawn(self.starts, *self._resume)
            except OSError as error:
                log.error("The recorder cannot be started: %s", error)
            else:
                self.starts += 1
                self._serve(child)
            if self._closing.is_set():
                return
            is_steady = time.monotonic() - begun_s > _STEADY_S
            delay_s = _BACKOFF_S[0 if is_steady else min(self.starts, len(_BACKOFF_S)) - 1]
            log.warning(
                "The recorder ended; started again in %g s. The robot is not affected.", delay_s
            )
            self._closing.wait(delay_s)

    def _serve(self, child: subprocess.Popen[bytes]) -> None:
        """Transfer orders and answers until it ends."""
        self._child, self._told_s, self.status = child, time.monotonic(), {}
        ended = threading.Event()
        threads = [
            threading.Thread(
                target=self._write, args=(child, ended), name="recorder-orders", daemon=True
            ),
            threading.Thread(
                target=self._read, args=(child,), name="recorder-answers", daemon=True
            ),
        ]
        for thread in threads:
            thread.start()
        while child.poll() is None:
            patience_s = STALLED_S if self.status else STARTING_S
            if time.monotonic() - self._told_s > patience_s and not self._closing.is_set():
                log.warning("The recorder has said nothing for %g s: ended.", patience_s)
                self._kill(child)
            with suppress(subprocess.TimeoutExpired):
                child.wait(0.2)
        ended.set()
        for thread in threads:
            thread.join(1.0)
        with self._changed:
            self.status, self.ends = {}, self.ends + 1
            self._changed.notify_all()
        self._observe(child.pid)

    def _write(self, child: subprocess.Popen[bytes], ended: threading.Event) -> None:
        assert child.stdin is not None
        with suppress(OSError, ValueError), child.stdin:  # it ended; orders of that moment are lost
            while not ended.is_set():
                try:
                    order = self._orders.get(timeout=0.2)
                except queue.Empty:
                    continue
                if not self._is_wanted(order):
                    continue
                child.stdin.write(json.dumps(order, default=str).encode() + b"\n")
                child.stdin.flush()
                if order["do"] == "leave":
                    return

    def _is_wanted(self, order: Mapping[str, object]) -> bool:
        """True unless the caller of the order has given up."""
        with self._changed:
            return "number" not in order or order["number"] in self._awaited

    def _read(self, child: subprocess.Popen[bytes]) -> None:
        assert child.stdout is not None
        with child.stdout:
            for line in child.stdout:
                if not line.endswith(b"\n"):
                    return  # it was killed within a line; who waits is told that it ended
                answer = parse_line(line) or {}
                with self._changed:
                    if isinstance(answer.get("status"), dict):
                        self.status, self._told_s = answer["status"], time.monotonic()
                    elif isinstance(answer.get("re"), int):
                        self._take(answer)
                    else:
                        log.error("The recorder sent a line that is no answer: %.200r", line)
                        self.broken += 1
                    self._changed.notify_all()

    def _take(self, answer: dict[str, Any]) -> None:
        """Keep an answer for its caller; with `_changed` held."""
        if answer["re"] in self._awaited:
            self._answers[answer["re"]] = answer
        elif answer.get("id"):  # nobody knows of the recording, so that nobody would end it
            log.warning("The recording %s began too late: ended.", answer["id"])
            self._put({"do": "stop", "run": answer["id"], "facts": {}})

    def _kill(self, child: subprocess.Popen[bytes]) -> None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(child.pid, signal.SIGKILL)
        with suppress(subprocess.TimeoutExpired):
            child.wait(2.0)

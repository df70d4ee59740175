"""Time until a fault is detected, and until the arm stands: crashes and emergency stops of a moving
arm, in one run.

    python benchmarks/bench_faults.py [--trials 100] [--rows 16 --delay-ms 100] [--json out.json]

An arm swings at 30 Hz. Each trial waits until it moves, causes one fault, and observes the joints:
"last motion" is the time from the fault to the last change of the measured joints; "noticed" is
when the supervisor's watch notified its listeners; "hold" is when control commanded, or the driver
reported, a hold. Only the killed module is restarted. The gantry reaches each command at once, so
that its last motion is that of the last command; an arm with inertia adds its braking. With --rows
the backend answers with chunks, executed in the mode `auto`. The floor is the time until this
process detects that a bare child was killed.

A trial with an event that did not occur in time is reported as missed and has no times; the cell is
restarted for the next trial. Exit status 1 if no trial of a fault succeeded.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from fault_loop import JointWitness, moving_cell
from plugin_site import chunks
from rich.console import Console
from rich.table import Table

from roboneuron.errors import RoboNeuronError
from roboneuron.modules.settings import EMERGENCY_STOP_TOPIC, ModuleKind
from roboneuron.selection.requests import StartChosenInference
from roboneuron.server.loop import ClosedLoop
from roboneuron.supervisor.health import Health, ModuleView, Watch
from roboneuron.tools.loop.instructing import give_instruction

RATE_HZ = 30.0
NOTICE, MOTION, HOLD = "noticed", "last motion", "hold"
BOUNDS_S = {
    ("inference killed", NOTICE): 0.5,
    ("inference killed", HOLD): 0.5,
    ("perception killed", NOTICE): 0.5,
    ("perception killed", HOLD): 1.0,
    ("control killed", NOTICE): 0.5,
    ("control killed", HOLD): 1.0 + 0.3,
    ("inference frozen", NOTICE): 0.5,
    ("emergency stop, by file and topic", MOTION): 0.1,
    ("emergency stop, by the file alone", MOTION): 0.1,
    ("emergency stop, by the topic alone", MOTION): 0.1,
}
"""Limits of the configuration and the issue; printed next to the measurements."""
KINDS: tuple[ModuleKind, ...] = ("robot", "perception", "control", "inference")


class NotSeen(RuntimeError):
    """An event that a trial waits for did not occur."""


class Bench:
    """A moving cell, and its events."""

    def __init__(self, loop: ClosedLoop, witness: JointWitness) -> None:
        self.loop, self.witness = loop, witness
        self.times: dict[tuple[str, str], list[float]] = defaultdict(list)
        self._told: deque[tuple[float, str, Health]] = deque(maxlen=200)
        self._holds: deque[float] = deque(maxlen=200)
        self._changed = threading.Condition()
        from std_msgs.msg import Bool
        from trajectory_msgs.msg import JointTrajectory

        from roboneuron.ros.link import RosLink
        from roboneuron.ros.qos import LATCHED

        namespace = loop.config.namespace
        self._link = link = RosLink("bench_faults")
        link.open()
        link.on_executor(
            lambda: link.node.create_subscription(
                JointTrajectory, f"/{namespace}/joint_trajectory", self._on_command, 100
            )
        )
        self._publish = link.advertise(Bool, f"/{namespace}/{EMERGENCY_STOP_TOPIC}", LATCHED)
        self._watch = Watch(loop.modules.views, self._on_health)
        self._watch.start()

    def close(self) -> None:
        """Stop the watch, and leave the ROS graph."""
        self._watch.close()
        self._link.close()

    def _on_command(self, message: Any) -> None:
        """Note a hold, which names the arm without its gripper."""
        if "finger" not in message.joint_names:
            with self._changed:
                self._holds.append(time.monotonic())
                self._changed.notify_all()

    def _on_health(self, view: ModuleView, before: Health, health: Health) -> None:
        with self._changed:
            self._told.append((time.monotonic(), view.kind, health))
            self._changed.notify_all()

    def _first(self, find: Callable[[], float | None], timeout_s: float, what: str) -> float:
        with self._changed:
            if not self._changed.wait_for(lambda: find() is not None, timeout_s):
                raise NotSeen(f"not within {timeout_s:g} s: {what}")
            found = find()
        assert found is not None
        return found

    def noticed_s(self, kind: str, health: Health, since_s: float) -> float:
        """Time at which the watch reported this health of a module."""
        return self._first(
            lambda: next(
                (at for at, k, h in self._told if at >= since_s and (k, h) == (kind, health)), None
            ),
            3.0,
            f"{kind} is {health}",
        )

    def held_s(self, since_s: float) -> float:
        """Time at which control commanded a hold."""
        return self._first(
            lambda: next((at for at in self._holds if at >= since_s), None), 3.0, "control holds"
        )

    def driver_held_s(self, since_s: float) -> float:
        """Time at which the driver's hold was reported; reports come every 0.2 s, so that older
        ones describe the time before.
        """

        def holding() -> bool:
            report = self.loop.modules.view("robot").report
            return (
                report is not None
                and report.received_s > since_s + 0.4
                and report.note == "holding: no command"
            )

        if not self.loop.modules.changes.wait_for(holding, 3.0):
            raise NotSeen("not within 3 s: the driver holds")
        return time.monotonic()

    def ready(self) -> None:
        """Wait until the arm moves steadily: by 5 mm within the last 0.3 s."""
        deadline_s = time.monotonic() + 30.0
        while time.monotonic() < deadline_s:
            recent = [x for at, x in self.witness.joints() if at > time.monotonic() - 0.3]
            if recent and max(recent) - min(recent) > 0.005:
                return
            time.sleep(0.01)
        said = {view.kind: view.report for view in self.loop.modules.views()}
        raise NotSeen(f"the arm does not move; the modules say: {said}")

    def stood_s(self, since_s: float) -> float:
        """Last motion after `since_s`, once the arm has been at rest for 0.4 s."""
        deadline_s = time.monotonic() + 5.0
        while not self.witness.stands():
            if time.monotonic() > deadline_s:
                raise NotSeen("the arm does not stand")
            time.sleep(0.01)
        last = self.witness.moved_s()
        assert last is not None
        return max(0.0, last - since_s)

    def note(self, fault: str, word: str, took_s: float) -> None:
        """Store one time."""
        self.times[fault, word].append(took_s)

    def kill(self, kind: ModuleKind) -> None:
        """Crash a module once, and restart it."""
        fault = f"{kind} killed"
        process = self.loop.modules.view(kind).process
        assert process is not None
        self.ready()
        at_s = time.monotonic()
        os.kill(process.pid, signal.SIGKILL)
        self.note(fault, NOTICE, self.noticed_s(kind, "exited", at_s) - at_s)
        self.note(
            fault,
            HOLD,
            (self.driver_held_s(at_s) if kind == "control" else self.held_s(at_s)) - at_s,
        )
        self.note(fault, MOTION, self.stood_s(at_s))
        self.restart(kind)

    def restart(self, kind: ModuleKind) -> None:
        """Start a module, and the motion again."""
        arguments = (
            StartChosenInference(instruction="swing", options={}) if kind == "inference" else None
        )
        self.loop.start(kind, arguments)
        self._swing()

    def _swing(self) -> None:
        """Start the motion again, because a restart or a release starts none."""
        if (
            self.loop.modules.view("inference").phase == "running"
            and not self.loop.starts.instruction
        ):
            give_instruction(self.loop, "swing", 10.0)

    def attempt(self, what: str, trial: Callable[[], None]) -> None:
        """Run a trial; a missing event is reported, and the cell restarted."""
        try:
            trial()
        except (NotSeen, RoboNeuronError) as error:
            print(f"missed: {what}: {error}", flush=True)
            self._release()
            for kind in KINDS:
                if self.loop.modules.view(kind).phase != "running":
                    self.restart(kind)

    def freeze(self) -> None:
        """Suspend inference, and resume it."""
        process = self.loop.modules.view("inference").process
        assert process is not None
        self.ready()
        at_s = time.monotonic()
        os.kill(process.pid, signal.SIGSTOP)
        try:
            self.note(
                "inference frozen", NOTICE, self.noticed_s("inference", "silent", at_s) - at_s
            )
            self.note("inference frozen", HOLD, self.held_s(at_s) - at_s)
            self.note("inference frozen", MOTION, self.stood_s(at_s))
        finally:
            os.kill(process.pid, signal.SIGCONT)
        modules = self.loop.modules
        if not modules.changes.wait_for(
            lambda: (
                (report := modules.view("inference").report) is not None
                and report.needs_start != ""
            ),
            3.0,
        ):
            raise NotSeen("not within 3 s: inference knows that it was frozen")
        give_instruction(self.loop, "swing", 10.0)

    def press(self, way: str, press: Callable[[], object]) -> None:
        """Trigger one emergency stop, and reset it."""
        fault = f"emergency stop, {way}"
        self.ready()
        at_s = time.monotonic()
        press()
        self.note(fault, "call", time.monotonic() - at_s)
        self.note(fault, HOLD, self.held_s(at_s) - at_s)
        self.note(fault, MOTION, self.stood_s(at_s))
        self._release()
        self._swing()

    def stops(self) -> None:
        """Trigger one stop in each way."""
        from std_msgs.msg import Bool

        stop, namespace = self.loop.emergency_stop, self.loop.config.namespace
        ways: dict[str, Callable[[], object]] = {
            "by file and topic": lambda: stop.latch(namespace, who="bench", reason="trial"),
            "by the file alone": lambda: stop.file.latch(who="bench", reason="trial"),
            "by the topic alone": lambda: self._publish(Bool(data=True)),
        }
        for way, press in ways.items():
            self.attempt(f"emergency stop, {way}", partial(self.press, way, press))

    def _release(self) -> None:
        from std_msgs.msg import Bool

        self._publish(Bool(data=False))
        self.loop.emergency_stop.reset(self.loop.config.namespace, who="bench", role="admin")


def floor_s(trials: int) -> list[float]:
    """Times from SIGKILL of a bare child to the return of the call that waits for it."""
    times = []
    for _ in range(trials):
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
        time.sleep(0.05)
        at_s = time.monotonic()
        child.kill()
        child.wait(10)
        times.append(time.monotonic() - at_s)
    return times


def main() -> int:
    """Run every trial and print one table; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=100, help="of each fault")
    parser.add_argument(
        "--rows", type=int, default=1, metavar="N", help="actions of a chunk, one each period"
    )
    parser.add_argument(
        "--delay-ms", type=float, default=0.0, metavar="MS", help="time that a prediction takes"
    )
    parser.add_argument("--json", type=Path, help="write the raw seconds here")
    arguments = parser.parse_args()
    progress = Console(stderr=True)
    with tempfile.TemporaryDirectory() as scratch:
        policy = chunks(arguments.rows, arguments.delay_ms, RATE_HZ)
        with moving_cell(Path(scratch), RATE_HZ, backend="steady", policy=policy) as (
            loop,
            witness,
        ):
            bench = Bench(loop, witness)
            try:
                for trial in range(arguments.trials):
                    for kind in ("inference", "perception", "control"):
                        bench.attempt(f"{kind} killed", partial(bench.kill, kind))
                    bench.attempt("inference frozen", bench.freeze)
                    bench.stops()
                    progress.log(f"trial {trial + 1}/{arguments.trials}")
            finally:
                bench.close()
        times = {**bench.times, ("bare child killed", "floor"): floor_s(arguments.trials)}
    table = Table(title=f"{arguments.trials} trials of each fault, arm moving at 30 Hz")
    for head in ("fault", "what", "median [ms]", "p99 [ms]", "max [ms]", "bound [ms]"):
        table.add_column(head)
    for (fault, word), values in times.items():
        median, p99, most = np.percentile(values, [50, 99, 100]) * 1e3
        bound_s = BOUNDS_S.get((fault, word))
        table.add_row(
            fault,
            word,
            f"{median:.0f}",
            f"{p99:.0f}",
            f"{most:.0f}",
            "" if bound_s is None else f"{bound_s * 1e3:.0f}",
        )
    Console(width=130).print(table)
    if arguments.json:
        arguments.json.write_text(
            json.dumps({f"{fault}: {word}": values for (fault, word), values in times.items()})
        )
    unseen = sorted({fault for fault, _ in BOUNDS_S} - {fault for fault, _ in times})
    for fault in unseen:
        print(f"no trial of {fault!r} succeeded")
    return 1 if unseen else 0


if __name__ == "__main__":
    sys.exit(main())

"""Start of one module, from its plan to a process that has passed its readiness check."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from roboneuron.config import ModuleSettings
from roboneuron.errors import InternalError, NotReadyError, RoboNeuronError
from roboneuron.modules.settings import ModuleKind
from roboneuron.planning import Plan
from roboneuron.ros.claim import LEAVE_S, claimant, runs_already
from roboneuron.supervisor.changes import Lasting, Stage
from roboneuron.supervisor.health import Modules
from roboneuron.supervisor.lifecycle import NodeClient
from roboneuron.supervisor.process import ModuleProcess, end_processes
from roboneuron.supervisor.slot import Phase, Slot

log = logging.getLogger(__name__)
_REASON_S = 1.0
"""Wait for the reason of a refused transition: it is published just before the response, but may
arrive a little later.
"""
_PROGRESS_S = 5.0
"""Period of progress reports in a long start, such as loading a large model."""
_ABSENT_S = 3.0
"""Grace time for modules that this one needs: modules may be started in parallel, in any order."""
_ROBOT_S = 1.0
"""Grace time for the robot, for cameras that need its driver."""
_PERSISTENT_S = 1.5
"""An error that lasts this long while a module is active but not ready ends the start; shorter
errors may clear by themselves.
"""


class Bringup:
    """One start of one module in a slot that was claimed for it; used once, on the caller's
    thread.
    """

    _process: ModuleProcess

    def __init__(
        self,
        slot: Slot,
        plan: Plan,
        settings: ModuleSettings,
        modules: Modules,
        client: Callable[[Slot, Callable[[], None]], NodeClient],
        on_stage: Stage,
    ) -> None:
        """Args:
        slot: slot claimed for the module.
        plan: what is started.
        settings: settings for its process.
        modules: the other modules, some of which this one needs.
        client: creates the client of the node in a slot, which calls a function while it waits.
        on_stage: called with a phrase at each stage of the start.
        """
        self._slot = slot
        self._inputs = plan.inputs
        self._settings = settings
        self._modules = modules
        self._changes = modules.changes
        self._make_client = client
        self._on_stage = on_stage
        self._node = f"/{settings.status_name}"
        self._timeout_s = settings.config.start_timeout_s(slot.kind)
        self._deadline_s = time.monotonic() + self._timeout_s

    @contextmanager
    def settled(self) -> Iterator[None]:
        """Settle the slot after the start, which is the body of the `with`; a failure ends the
        process.
        """
        slot = self._slot
        phase: Phase = "stopped"
        try:
            yield
            phase = "running"
        finally:
            try:
                if phase != "running" and slot.process is not None:
                    end_processes([slot.process], slot.stop_timeout_s)
            finally:
                # also when it survives SIGKILL, otherwise no other start would be possible
                slot.settle(phase)
            if slot.process is not None and slot.process.exit_code is not None:
                self._on_exit(slot.process)  # it died between its readiness check and here
            self._modules.on_change(slot.kind)

    def check_robot(self) -> None:
        """Refuse a source that needs the robot's driver if there is no robot.

        Raises:
            NotReadyError: the robot is neither running nor being started.
        """
        if self._slot.kind == "perception" and not self._changes.wait_for(
            lambda: not self._absent(), _ROBOT_S, self._slot.check_not_cancelled
        ):
            raise NotReadyError(
                "The images come from the driver of the robot, which is not running.",
                hint="Call start_robot first.",
            )

    def _on_exit(self, process: ModuleProcess) -> None:
        """Handle the end of the process; called on its reaper's thread, and at the end of the
        start.
        """
        if self._slot.note_exit(process):
            log.error("%s is gone: %s", self._slot.kind, self._slot.explain_exit())
            self._modules.on_change(self._slot.kind)

    def prove(self, process: ModuleProcess) -> None:
        """Configure, activate, and wait for readiness.

        Each step first waits for its precondition: a first status shows that the process is alive
        and its messages arrive, an answered service that it can be driven.

        Args:
            process: the module's, just started.

        Raises:
            RoboNeuronError: see `Supervisor.start`.
        """
        self._process = self._slot.process = process
        process.reap(self._on_exit)
        self._stage("starting")
        client = self._client = self._make_client(self._slot, self._check)
        self._check_alone()
        if self._changes.wait_for(lambda: self._slot.report, self._left_s(), self._check) is None:
            raise self._too_late("its first status on /diagnostics")
        if not client.wait_until_served(self._left_s()):
            raise self._too_late("its lifecycle services")
        self._check_alone()
        self._transition("configure")
        self._transition("activate")
        self._await_ready()
        self._process.show()

    def _transition(self, name: str) -> None:
        """Make one lifecycle transition.

        Raises:
            NotReadyError: no answer by the deadline.
            RoboNeuronError: the reason that the module reports for its refusal.
        """
        self._stage(f"{name.removesuffix('e')}ing")
        report = self._slot.report
        before = report.error_count if report is not None else 0
        made = self._client.transition(name, self._left_s())
        if made is None:
            raise self._too_late(f"the answer to {name!r}")
        if made:
            return

        def reason() -> RoboNeuronError | None:
            report = self._slot.report
            return report.failure() if report is not None and report.error_count > before else None

        failure = self._changes.wait_for(reason, _REASON_S)
        if failure is not None:
            raise failure
        raise InternalError(
            f"The {self._slot.kind} module refused to {name} and gave no reason.",
            hint=f"See {self._process.log_path}.",
        )

    def _await_ready(self) -> None:
        """Wait until the module reports that it is ready.

        Raises:
            NotReadyError: an input is missing at the deadline, or comes from a module that is not
                being started.
            RoboNeuronError: the module reports an error that lasts.
        """
        self._stage("waiting for the first output")
        failing, absence = Lasting(), Lasting()
        reported = ""

        def ready() -> bool:
            nonlocal reported
            self._check()
            report = self._slot.report
            if report is None:
                return False
            if report.ready and report.state == "active":
                return True
            failure = report.failure()
            # a late input may still arrive
            lasts = failure is not None and not isinstance(failure, NotReadyError)
            if failing.held_s(lasts) > _PERSISTENT_S and failure is not None:
                raise failure
            if report.waiting_for and report.waiting_for != reported:
                reported = report.waiting_for
                self._on_stage(f"{self._slot.kind}: waiting for {reported}")
            absent = self._absent() if report.waiting_for else ()
            if absence.held_s(bool(absent)) > _ABSENT_S:
                raise NotReadyError(
                    f"{self._slot.kind} waits for {report.waiting_for}; not running: "
                    f"{', '.join(absent)}.",
                    hint=f"Call {', '.join(f'start_{kind}' for kind in absent)} first.",
                )
            return False

        if not self._changes.wait_for(ready, self._left_s()):
            report = self._slot.report
            raise self._too_late(
                report.waiting_for if report and report.waiting_for else "its first output"
            )

    def _absent(self) -> list[ModuleKind]:
        """Modules whose outputs this one needs and that are neither running nor being started."""
        return [
            kind
            for kind in self._inputs
            if self._modules.slot(kind).phase not in ("starting", "running")
        ]

    def _check_alone(self) -> None:
        """Refuse the start if another node has the same name: both would obey each lifecycle
        request, and another server's robot could move.

        A node on this machine is recognised at once, one on another machine by its status. Modules
        left over from a stopped server get the time that their exit may take.
        """
        if not self._changes.wait_for(lambda: self._other() is None, LEAVE_S):
            raise runs_already(self._node, self._other() or 0)

    def _other(self) -> int | str | None:
        """Process id of another node with this name."""
        # the claim is visible at once, before DDS has discovered the other node
        holder = claimant(self._node)
        if holder not in (None, self._process.pid):
            return holder
        return self._modules.foreign(self._settings.status_name)

    def _too_late(self, missing: str) -> RoboNeuronError:
        """Create the error for a start that took too long.

        Args:
            missing: what the start waited for.
        """
        report = self._slot.report
        said = f" It says: {report.error}" if report is not None and report.error else ""
        return NotReadyError(
            f"{self._slot.kind} (pid {self._process.pid}) was not ready within "
            f"{self._timeout_s:g} s; "
            f"missing: {missing}.{said}",
            hint=f"The process was ended; its log is {self._process.log_path}. If it only needs "
            "longer, raise "
            f"start_timeout_s in [{self._slot.kind}].",
        )

    def _left_s(self) -> float:
        return max(0.0, self._deadline_s - time.monotonic())

    def _stage(self, doing: str) -> None:
        self._doing = doing
        self._since_s = self._reported_s = time.monotonic()
        self._on_stage(f"{self._slot.kind}: {doing}")

    def _check(self) -> None:
        """Check during every wait of a start; raises if waiting is pointless."""
        self._slot.check_not_cancelled()
        self._slot.check_alive(self._doing)
        self._report_progress()

    def _report_progress(self) -> None:
        """Report the elapsed time and the memory in use while a module loads, which may take
        minutes.
        """
        now_s = time.monotonic()
        if now_s - self._reported_s >= _PROGRESS_S:
            self._reported_s = now_s
            self._on_stage(
                f"{self._slot.kind}: {self._doing}, {now_s - self._since_s:.0f} of at most "
                f"{self._timeout_s:g} s"
                f"{_memory(self._process.pid)}"
            )


def _memory(pid: int) -> str:
    """Memory of a living process, such as ", 12.3 GB in memory"; otherwise empty."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError, ValueError):
        return ""
    return f", {pages * os.sysconf('SC_PAGE_SIZE') / 1e9:.1f} GB in memory"

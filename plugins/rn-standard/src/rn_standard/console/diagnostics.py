"""Status without a server: the modules' reports on /diagnostics, and the servers that use this
state directory.

A server on stdio communicates only with the client that started it. Its modules report on
/diagnostics five times a second, its process id is in the name of its log directory, and the
emergency stop is a file. That is sufficient to show the state of the modules without affecting
them.
"""

from __future__ import annotations

import os
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rn_standard.console.log_runs import log_runs
from rn_standard.console.status import ReportedModule, ServerStatus
from roboneuron.feature import Health, ModuleView, Report, estop, reading

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray

_KINDS: tuple[str, ...] = ("robot", "perception", "inference", "control")
"""Shown first, in this order."""
FORGET_S = 5.0
"""Time after which a silent module without a process is no longer shown."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FoundServer:
    """A running server process.

    Attributes:
        domain: its ROS domain.
        log_directory: log directory of its run.
    """

    pid: int
    domain: str
    log_directory: Path


def find_servers(state_directory: Path) -> list[FoundServer]:
    """Running servers that log below this state directory, newest first; those of other users are
    left out.
    """
    found = []
    folders = [state_directory, *sorted(reading.robot_folder(state_directory).parent.glob("*"))]
    for run in (run for folder in folders for run in log_runs(folder)):
        command = _read_proc(run.pid, "cmdline").split("\0")
        if "serve" in command and any("roboneuron" in word for word in command):
            variables = dict(
                entry.partition("=")[::2] for entry in _read_proc(run.pid, "environ").split("\0")
            )
            found.append(
                FoundServer(
                    pid=run.pid,
                    domain=variables.get("ROS_DOMAIN_ID") or "0",
                    log_directory=run.path,
                )
            )
    return found


def _read_proc(pid: int, name: str) -> str:
    try:
        return Path(f"/proc/{pid}/{name}").read_text(encoding="utf-8", errors="replace")
    except OSError:  # ended, or of another user
        return ""


class DiagnosticsListener:
    """Keeps the newest report of every module process in this ROS domain; to be closed."""

    def __init__(self, state_directory: Path) -> None:
        self._state_directory = state_directory
        self._reports: dict[tuple[str, str, int], Report] = {}
        # reports come on the thread of the ROS node
        self._lock = threading.Lock()

    def open(self) -> None:
        """Join the ROS graph; raises as `roboneuron.ros.environment.prepare_environment`."""
        from roboneuron.command import environment

        environment.prepare_environment()
        from diagnostic_msgs.msg import DiagnosticArray  # heavy

        from roboneuron.command import RosLink
        from roboneuron.feature import topics

        self._link = RosLink(f"roboneuron_status_{os.getpid()}")
        self._link.open()
        self._link.subscribe(DiagnosticArray, topics.DIAGNOSTICS, self.receive)

    def close(self) -> None:
        """Leave the graph."""
        self._link.close()

    def receive(self, message: DiagnosticArray) -> None:
        """Store the reports of modules in a message; called on the thread of the ROS link."""
        for status in message.status:
            namespace, _, node = status.name.strip("/").rpartition("/")
            values = {pair.key: pair.value for pair in status.values}
            if (
                not node.isidentifier()
                or not {"state", "ready"} <= values.keys()
                or not status.hardware_id.isdecimal()
            ):
                continue  # of the supervisor, or of a foreign node
            report = Report.from_values(values, received_s=time.monotonic())
            with self._lock:
                self._reports[namespace, node, int(status.hardware_id)] = report

    def servers_elsewhere(self) -> list[str]:
        """A line for each server whose modules are not visible in this ROS domain."""
        return [
            f"A server (pid {server.pid}) runs in ROS domain {server.domain}: "
            f"ROS_DOMAIN_ID={server.domain} roboneuron status"
            for server in find_servers(self._state_directory)
            if server.domain != own_domain()
        ]

    def read_status(self) -> list[ServerStatus]:
        """One status for each robot with reporting modules; if there is none, one without
        modules.
        """
        now_s = time.monotonic()
        with self._lock:
            for key, report in list(self._reports.items()):
                if now_s - report.received_s > FORGET_S and not Path(f"/proc/{key[2]}").exists():
                    del self._reports[key]
            reports = dict(self._reports)
        domain = own_domain()
        servers = [
            server for server in find_servers(self._state_directory) if server.domain == domain
        ]
        found = []
        for namespace in sorted({key[0] for key in reports}) or [""]:
            modules = [
                ReportedModule.from_report(node, pid, _health(node, pid, report, now_s), report)
                for (place, node, pid), report in sorted(reports.items(), key=_in_order)
                if place == namespace
            ]
            server = _server_of([m.pid for m in modules if m.pid is not None], servers)
            runs = [
                one.log_directory for one in servers if server is not None and one.pid == server.pid
            ]
            directory = self._folder_of(namespace, runs)
            latch = estop.EmergencyStopLatch.in_directory(directory).read_state()
            found.append(
                ServerStatus(
                    source=f"/diagnostics of ROS domain {domain}",
                    namespace=namespace,
                    pid=server.pid if server is not None else None,
                    emergency_stop=latch.latched,
                    emergency_stop_cause=latch.cause,
                    log_directory=str(server.log_directory) if server is not None else "",
                    modules=tuple(modules),
                )
            )
        return found

    def _folder_of(self, namespace: str, runs: list[Path]) -> Path:
        """Folder with the latch of a robot: a server of several robots stores the namespace in each
        one's folder.

        For a single robot it is the state directory itself.

        Args:
            namespace: namespace of the robot.
            runs: log directories of its server, `<folder>/log/<run>`; empty if the server has
                ended.
        """
        folders = sorted(reading.robot_folder(self._state_directory).parent.glob("*"))
        own = [
            folder
            for folder in folders
            if not runs or any(run.is_relative_to(folder) for run in runs)
        ]
        return next(
            (folder for folder in own if _noted_namespace(folder) == namespace),
            self._state_directory,
        )


def own_domain() -> str:
    """The ROS domain of this process."""
    return os.environ.get("ROS_DOMAIN_ID") or "0"


def _noted_namespace(folder: Path) -> str:
    try:
        return (folder / "namespace").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def _in_order(item: tuple[tuple[str, str, int], Report]) -> tuple[str, int, int]:
    (namespace, node, pid), _ = item
    kind = _kind_of(node)
    return namespace, [*_KINDS, kind].index(kind), pid


def _kind_of(node: str) -> str:
    """Kind of a module's node: nodes have the name of their kind, after a switch with a suffix."""
    return next((kind for kind in _KINDS if node.startswith(f"{kind}_")), node)


def _health(node: str, pid: int, report: Report, now_s: float) -> Health:
    """Health as determined by the server, except that a start in progress looks like "waiting"."""
    if not Path(f"/proc/{pid}").exists():
        return "exited"
    return ModuleView(kind=_kind_of(node), phase="running", report=report).health(now_s)


def _server_of(pids: list[int], servers: list[FoundServer]) -> FoundServer | None:
    """The server that is the parent of these modules; without modules the newest one."""
    if not pids:
        return servers[0] if servers else None
    parents = {_parent(pid) for pid in pids}
    return next((server for server in servers if server.pid in parents), None)


def _parent(pid: int) -> int:
    """Source: proc(5): the fourth field of /proc/<pid>/stat, the second being a name in
    parentheses.
    """
    fields = _read_proc(pid, "stat").rpartition(")")[2].split()
    return int(fields[1]) if len(fields) > 1 else 0

"""Stopping module processes, their death by other causes, and their remains: none."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from rn_testing.fakes import fake_plan
from rn_testing.waiting import wait_for_line, wait_until
from roboneuron.config import Config
from roboneuron.errors import NotReadyError, StateError
from roboneuron.supervisor import bringup
from roboneuron.supervisor.process import ModuleProcess, end_processes
from roboneuron.supervisor.supervisor import Supervisor

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]
MakeConfig = Callable[..., Config]
PATIENCE_S = 15.0
"""Two seconds on an idle machine; the bound only distinguishes a slow end from a hang."""


def is_gone(pid: int) -> bool:
    """True if there is no such process, or only an orphan that has ended and is not reaped by its
    new parent yet.
    """
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def start(supervisor: Supervisor, config: Config, kind: str = "robot") -> int:
    view = supervisor.start(fake_plan(kind, config))  # type: ignore[arg-type]
    assert view.process is not None
    return view.process.pid


def test_a_stopped_module_was_deactivated_and_is_reaped(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    pid = start(supervisor, make_config())
    stopped = supervisor.stop("robot")
    assert (stopped.pid, stopped.exit_code, stopped.killed) == (pid, 0, False)
    assert is_gone(pid)
    assert "deactivated" in (supervisor.log_directory / "robot.log").read_text()
    assert supervisor.view("robot").phase == "stopped"


def test_a_failed_start_whose_process_cannot_be_ended_leaves_a_slot_that_can_be_used(
    supervisor: Supervisor, make_config: MakeConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that hangs in a driver survives SIGKILL for a while, as on an overloaded
    machine.
    """

    def end(processes: Sequence[ModuleProcess], timeout_s: float) -> set[int]:
        end_processes(processes, timeout_s)
        raise NotReadyError("It survives SIGKILL.")

    with monkeypatch.context() as patch:
        patch.setattr(bringup, "end_processes", end)
        with pytest.raises(NotReadyError, match="survives"):
            supervisor.start(fake_plan("robot", make_config(robot="refuses-configure")))
    assert supervisor.view("robot").phase == "stopped"
    start(supervisor, make_config())


def test_a_stop_of_what_is_not_running_is_an_error(supervisor: Supervisor) -> None:
    with pytest.raises(StateError, match="robot is not running"):
        supervisor.stop("robot")


@pytest.mark.parametrize("fault", ["ignores-sigterm", "has-a-child"])
def test_what_does_not_leave_is_killed_with_its_children(
    supervisor: Supervisor, make_config: MakeConfig, fault: str
) -> None:
    pid = start(supervisor, make_config(stop_timeout_s=1.0, robot=fault))
    report = supervisor.view("robot").report
    assert report is not None
    stopped = supervisor.stop("robot")
    assert stopped.killed == (fault == "ignores-sigterm")
    assert stopped.took_s < PATIENCE_S
    assert is_gone(pid)
    if fault == "has-a-child":
        wait_until(
            lambda: is_gone(int(report.metrics["child_pid"])), PATIENCE_S, "its child is gone"
        )


def test_a_frozen_process_is_killed(supervisor: Supervisor, make_config: MakeConfig) -> None:
    pid = start(supervisor, make_config(stop_timeout_s=1.0))
    os.kill(pid, signal.SIGSTOP)
    stopped = supervisor.stop("robot")
    assert stopped.killed
    assert is_gone(pid)


def test_an_unexpected_death_is_noticed_at_once_with_its_last_words(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    pid = start(supervisor, make_config())
    killed_s = time.monotonic()
    os.kill(pid, signal.SIGKILL)
    wait_until(
        lambda: supervisor.view("robot").phase == "exited", 0.5, "the death is in the status"
    )
    print(f"noticed after {1e3 * (time.monotonic() - killed_s):.0f} ms")
    view = supervisor.view("robot")
    assert view.process is not None
    assert (view.process.pid, view.process.exit_code) == (pid, -9)
    assert view.process.ended_at > view.process.started_at
    assert "fake robot with fault ''" in view.process.last_lines()
    with pytest.raises(StateError, match=rf"\(pid {pid}\) ended by itself with signal 9"):
        supervisor.stop("robot")
    start(supervisor, make_config())
    assert supervisor.view("robot").phase == "running"


def test_a_death_right_after_the_proof_is_noticed(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    start(supervisor, make_config(robot="dies-when-ready"))
    wait_until(
        lambda: supervisor.view("robot").phase == "exited", 3.0, "the death is in the status"
    )
    exited = supervisor.view("robot").process
    assert exited is not None
    assert exited.exit_code == 13


def test_everything_is_stopped_in_reverse_order_and_no_thread_remains(
    tmp_path: Path, make_config: MakeConfig, fake_command: Callable[[str | None], list[str]]
) -> None:
    threads = set(threading.enumerate())
    ended: list[str] = []
    supervisor = Supervisor(tmp_path, command=fake_command, on_change=ended.append)
    config = make_config()
    pids = [start(supervisor, config, kind) for kind in ("robot", "perception", "control")]
    ended.clear()
    started_s = time.monotonic()
    supervisor.close()
    supervisor.close()
    assert time.monotonic() - started_s < 5.0
    assert ended == ["control", "perception", "robot"]
    assert all(is_gone(pid) for pid in pids)
    assert set(threading.enumerate()) - threads == set()
    with pytest.raises(StateError, match="shutting down"):
        supervisor.start(fake_plan("robot", config))


PARENT = """
import sys, time
from pathlib import Path
from rn_testing.fakes import fake_plan
from roboneuron.config import parse_config
from roboneuron.supervisor.supervisor import Supervisor
config = parse_config('[robot]\\nname = "fake"\\n[plugins.fault]\\nperception = "has-a-child"')
supervisor = Supervisor(Path({state!r}), command=lambda python: {command!r})
for kind in ("robot", "perception"):
    view = supervisor.start(fake_plan(kind, config))
    print("pid", view.process.pid, flush=True)
print("pid", view.report.metrics["child_pid"], flush=True)
time.sleep(60)
"""


def test_the_modules_of_a_killed_server_end_with_it(
    tmp_path: Path, fake_command: Callable[[str | None], list[str]]
) -> None:
    script = PARENT.format(command=fake_command(None), state=str(tmp_path))
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True
    ) as parent:
        pids = [int(wait_for_line(parent.stdout, "pid ").split()[1]) for _ in range(3)]
        parent.kill()
    wait_until(
        lambda: all(is_gone(pid) for pid in pids),
        PATIENCE_S,
        "both modules are gone, and the child of one",
    )


def test_modules_and_their_children_die_when_their_parent_is_killed(
    tmp_path: Path, fake_command: Callable[[str | None], list[str]]
) -> None:
    script = PARENT.format(command=fake_command(None), state=str(tmp_path))
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True
    ) as parent:
        pids = [int(wait_for_line(parent.stdout, "pid ").split()[1]) for _ in range(3)]
        parent.kill()
        parent.wait(5)
        killed_s = time.monotonic()
        wait_until(
            lambda: all(is_gone(pid) for pid in pids),
            PATIENCE_S,
            "both modules are gone, and the child of one",
        )
        print(f"all gone {1e3 * (time.monotonic() - killed_s):.0f} ms after their parent")

"""With rn-fastdds, neither a killed module nor a killed server leaves shared memory."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rn_standard.fastdds.feature import SharedMemoryRepair
from rn_standard.fastdds.segments import SHARED_MEMORY, owned_segments
from rn_testing.fakes import fake_plan
from rn_testing.waiting import wait_for_line, wait_until
from roboneuron.config import Config, parse_config
from roboneuron.supervisor.supervisor import Supervisor

pytestmark = [pytest.mark.ros, pytest.mark.timeout(90)]
FAKE_MODULE = Path(__file__).parents[1] / "roboneuron-core/tests/supervisor/fake_module.py"
COMMAND = [sys.executable, "-u", "-P", str(FAKE_MODULE)]
CONFIG = '[robot]\nname = "fake"\n[supervisor]\nstop_timeout_s = 1.0\n'
SERVER = """
import time
from pathlib import Path
from types import SimpleNamespace
from rn_standard.fastdds.feature import SharedMemoryRepair
from rn_testing.fakes import fake_plan
from roboneuron.config import parse_config
from roboneuron.supervisor.supervisor import Supervisor
supervisor = Supervisor(Path({state!r}), command=lambda python: {command!r})
supervisor.link
SharedMemoryRepair(None).start(SimpleNamespace(modules=supervisor))
print("pid", supervisor.start(fake_plan("robot", parse_config({config!r}))).process.pid, flush=True)
time.sleep(60)
"""


def left(names: frozenset[str]) -> list[str]:
    """Those that are there without an owner: another process may own a port of that number by now,
    because Fast DDS chooses the lowest free one of this machine.
    """
    found = [name for name in names if (SHARED_MEMORY / name).exists()]
    processes = [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdecimal()]
    owned = frozenset().union(*map(owned_segments, processes)) if found else frozenset()
    return [name for name in found if name not in owned]


@pytest.fixture
def config() -> Config:
    return parse_config(CONFIG)


@pytest.fixture
def supervisor(tmp_path: Path) -> Iterator[Supervisor]:
    supervisor = Supervisor(tmp_path, command=lambda python: COMMAND)
    repair = SharedMemoryRepair(None)
    try:
        assert supervisor.link
        repair.start(cast(Any, SimpleNamespace(modules=supervisor)))
        yield supervisor
    finally:
        supervisor.close()
        repair.close()


@pytest.mark.exhaustive
def test_a_frozen_module_that_had_to_be_killed(supervisor: Supervisor, config: Config) -> None:
    process = supervisor.start(fake_plan("robot", config)).process
    assert process is not None
    segments = owned_segments(process.pid)
    assert segments
    os.kill(process.pid, signal.SIGSTOP)
    stopped = supervisor.stop("robot")
    assert stopped.killed
    assert left(segments) == []


def test_a_module_that_was_killed(supervisor: Supervisor, config: Config) -> None:
    process = supervisor.start(fake_plan("robot", config)).process
    assert process is not None
    segments = owned_segments(process.pid)
    os.kill(process.pid, signal.SIGKILL)
    wait_until(
        lambda: supervisor.view("robot").phase == "exited", 15.0, "the death is in the status"
    )
    assert left(segments) == []


def test_a_server_that_was_killed(tmp_path: Path) -> None:
    script = SERVER.format(command=COMMAND, state=str(tmp_path), config=CONFIG)
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True
    ) as server:
        pid = int(wait_for_line(server.stdout, "pid ").split()[1])
        segments = owned_segments(server.pid)
        server.kill()
    wait_until(lambda: not Path(f"/proc/{pid}").exists(), 15.0, "the module is gone")
    assert segments
    following, repair = (
        Supervisor(tmp_path, command=lambda python: COMMAND),
        SharedMemoryRepair(None),
    )
    following.open()
    assert following.link is not None
    repair.start(cast(Any, SimpleNamespace(modules=following)))
    following.close()
    repair.close()
    # others may have taken over a port meanwhile
    own = frozenset(name for name in segments if "port" not in name)
    assert left(own) == []
    assert list(tmp_path.glob("log/*/shared_memory")) == []

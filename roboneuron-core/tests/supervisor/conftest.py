"""A supervisor whose modules are `fake_module.py` or scripted, and processes that are shells."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest
from shells import ENVIRONMENT, Spawn, end_now
from stop_world import World

from rn_testing.domain import free_ros_domain
from roboneuron.config import Config, parse_config
from roboneuron.supervisor import changes as changes_module
from roboneuron.supervisor import process as process_module
from roboneuron.supervisor import supervisor as supervisor_module
from roboneuron.supervisor.process import ModuleProcess, ProcessEvents, spawn
from roboneuron.supervisor.supervisor import Supervisor

FAKE_MODULE = Path(__file__).with_name("fake_module.py")


@pytest.fixture(scope="session")
def fake_command() -> Callable[[str | None], list[str]]:
    """The supervisor's `command` that starts `fake_module.py` instead of `roboneuron.modules`."""
    return lambda python: [python or sys.executable, "-u", "-P", str(FAKE_MODULE)]


@pytest.fixture(scope="session", autouse=True)
def _own_domain() -> None:
    """Keep ROS traffic of this test run in its own domain."""
    os.environ.setdefault("ROS_DOMAIN_ID", str(free_ros_domain()))


@pytest.fixture
def make_config() -> Callable[..., Config]:
    """Return a function that makes a configuration with faults by kind, and timeouts."""

    def make(start_timeout_s: float = 20.0, stop_timeout_s: float = 3.0, **faults: str) -> Config:
        lines = [f'{kind} = "{word}"' for kind, word in faults.items()]
        return parse_config(
            '[robot]\nname = "fake"\n[inference]\nbackend = "fake"\n[supervisor]\n'
            f"start_timeout_s = {start_timeout_s}\nstop_timeout_s = "
            f"{stop_timeout_s}\n[plugins.fault]\n" + "\n".join(lines)
        )

    return make


@pytest.fixture
def supervisor(
    tmp_path: Path, fake_command: Callable[[str | None], list[str]]
) -> Iterator[Supervisor]:
    """A supervisor that is always closed at the end of the test."""
    supervisor = Supervisor(tmp_path, command=fake_command)
    try:
        yield supervisor
    finally:
        supervisor.close()


@pytest.fixture
def world(
    tmp_path: Path, make_config: Callable[..., Config], monkeypatch: pytest.MonkeyPatch
) -> Iterator[World]:
    """A supervisor with scripted modules, on a clock that only they advance."""
    world = World(tmp_path, make_config)
    for module in (changes_module, process_module, supervisor_module):
        monkeypatch.setattr(module, "time", world.clock)
    monkeypatch.setattr(supervisor_module, "NodeClient", world.client)
    yield world
    world.supervisor._spawning.shutdown()


@pytest.fixture
def log_path(tmp_path: Path) -> Path:
    """Log file of the processes of `start`."""
    return tmp_path / "log" / "arm.log"


@pytest.fixture
def start(log_path: Path) -> Iterator[Spawn]:
    """Return a function that starts a shell with a script and reaps it; all are killed at the
    end.
    """
    started: list[ModuleProcess] = []

    def run(
        script: str,
        *,
        first_line: str = "go",
        events: ProcessEvents | None = None,
        environment: Mapping[str, str] = ENVIRONMENT,
        on_exit: Callable[[ModuleProcess], None] | None = None,
    ) -> ModuleProcess:
        process = spawn(
            "arm",
            ("/bin/sh", "-c", script),
            environment,
            first_line,
            log_path,
            events or ProcessEvents(),
        )
        started.append(process)
        process.reap(on_exit or (lambda process: None))
        return process

    yield run
    for process in started:
        end_now(process)

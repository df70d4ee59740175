"""A supervisor whose modules are `fake_module.py`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rn_testing.domain import free_ros_domain
from roboneuron.config import Config, parse_config
from roboneuron.supervisor.supervisor import Supervisor

FAKE_MODULE = Path(__file__).with_name("fake_module.py")


@pytest.fixture(scope="session")
def fake_command() -> Callable[[str | None], list[str]]:
    """The supervisor's `command` that starts `fake_module.py` instead of `roboneuron.modules`."""
    return lambda python: [python or sys.executable, "-u", "-P", str(FAKE_MODULE)]


@pytest.fixture(scope="session", autouse=True)
def _own_domain() -> None:
    """ROS traffic of this test run stays in a domain of its own."""
    os.environ.setdefault("ROS_DOMAIN_ID", str(free_ros_domain()))


@pytest.fixture
def make_config() -> Callable[..., Config]:
    """Return a function: faults by kind, and timeouts, to a configuration."""

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
    """A supervisor that is closed at the end of the test, whatever happened."""
    supervisor = Supervisor(tmp_path, command=fake_command)
    try:
        yield supervisor
    finally:
        supervisor.close()

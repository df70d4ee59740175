"""What every test leaves as it found it, and fixtures that tests of several packages share."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from rn_testing.domain import free_ros_domain
from rn_testing.fakes.wheels import Wheels
from roboneuron.gate import AuditLog, EmergencyStopLatch
from roboneuron.ros.environment import prepare_environment

settings.register_profile(
    "busy-machine", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("busy-machine")


def pytest_configure(config: pytest.Config) -> None:
    """Give this process a ROS domain of its own: what runs side by side on one machine never meets.

    A worker of pytest-xdist inherits the domain of the process that distributes the tests, and so
    would its neighbour.
    """
    if hasattr(config, "workerinput") or "ROS_DOMAIN_ID" not in os.environ:
        os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    # A recorder beside every server would take a third of this machine; its own tests switch it on.
    os.environ["ROBONEURON_RECORDER"] = "off"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give tests that take minutes a bound of their own against hangs."""
    for item in items:
        takes_minutes = item.get_closest_marker("slow") or item.get_closest_marker("release")
        if takes_minutes and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(600))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, Any, Any]:
    """Import and collect without garbage collection, which took a fifth of that time, and exclude
    what is loaded then from all later collections.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.collect()
        gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def _pauses_of_the_interpreter() -> Iterator[None]:
    """Modules and servers freeze what they have loaded, since they live as long as their process;
    tests do not.

    Frozen ROS contexts are never collected: they keep their sockets, threads and shared memory.
    """
    interval_s = sys.getswitchinterval()
    frozen = gc.get_freeze_count()
    yield
    sys.setswitchinterval(interval_s)
    if gc.get_freeze_count() <= frozen:  # what is freed leaves the count
        gc.collect()
        return
    gc.unfreeze()
    gc.collect()
    gc.freeze()


@dataclass
class Clock:
    """Monotonic seconds and wall-clock nanoseconds that only a test moves."""

    now_s: float = 100.0
    start_ns: int = 1_700_000_000_000_000_000
    ticks: int = field(default=0)

    def monotonic(self) -> float:
        return self.now_s

    def wall_ns(self) -> int:
        self.ticks += 1
        return self.start_ns + self.ticks


@pytest.fixture
def clock() -> Clock:
    """A clock at rest."""
    return Clock()


@pytest.fixture
def latch(tmp_path: Path, clock: Clock) -> EmergencyStopLatch:
    """A latch in an empty directory."""
    return EmergencyStopLatch(tmp_path / "state" / "stop", clock.wall_ns)


@pytest.fixture
def audit(tmp_path: Path, clock: Clock) -> AuditLog:
    """An audit in an empty directory."""
    return AuditLog(tmp_path / "state" / "audit.jsonl", clock.wall_ns)


@pytest.fixture
def wheels(server_environment: dict[str, str], tmp_path: Path) -> Iterator[Wheels]:
    """What the wheels of the robot of `server_environment` are told."""
    prepare_environment(tmp_path / "ros")
    subscriber = Wheels(int(server_environment["ROS_DOMAIN_ID"]))
    yield subscriber
    subscriber.close()


@pytest.hookimpl(wrapper=True)
def pytest_report_to_serializable() -> Generator[None, Any, Any]:
    """Let a worker of pytest-xdist report whatever a test logged: what execnet cannot send would
    end the whole run.

    Half of a surrogate pair in a log line is enough for that, even in a test that passes.
    """
    return _sendable((yield))


def _sendable(value: Any) -> Any:
    if value is None or type(value) in (bool, int, float, bytes):
        return value
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, dict):
        return {_sendable(key): _sendable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        items = [_sendable(item) for item in value]
        return items if isinstance(value, list) else tuple(items)
    return repr(value)


def pytest_internalerror(excrepr: object) -> None:
    """Remember the first error of pytest itself; those that follow from it are printed last and
    hide it.
    """
    _internal_errors.append(str(excrepr))


@pytest.hookimpl(trylast=True)
def pytest_unconfigure() -> None:
    """Say it again at the very end."""
    if _internal_errors:
        last_lines = "\n".join(_internal_errors[0].splitlines()[-12:])
        print(f"\nThe first internal error ended so:\n{last_lines}", file=sys.stderr)


_internal_errors: list[str] = []

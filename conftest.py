"""What every test leaves as it found it, and fixtures that tests of several packages share."""

from __future__ import annotations

import gc
import os
import random
import re
import sys
import threading
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, settings

from rn_testing.domain import free_ros_domain
from roboneuron.errors import StateError
from roboneuron.ros.environment import prepare_environment

if TYPE_CHECKING:
    # Each run of pytest loads this file, and with pytest-xdist a process that runs no test: the
    # server alone would take a second.
    from rn_testing.fakes.wheels import CommandedWheels
    from roboneuron import Spec
    from roboneuron.plugins.registry import Registry
    from roboneuron.server.app import Application
    from roboneuron.server.tool import CallContext, NoArguments, Result

pytest_plugins = ("rn_testing.isolation", "rn_testing.gate_fixtures")
settings.register_profile(
    "busy-machine", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("busy-machine")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that changes the order of the tests."""
    parser.addoption(
        "--shuffle", type=int, metavar="SEED", help="run modules, and the tests of each, shuffled"
    )


def pytest_configure() -> None:
    """Give this process a ROS domain of its own: what runs side by side on one machine never meets.

    Nor does it meet the robots of the person who starts the tests.
    """
    os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    # A recorder beside every server would take a third of this machine; its own tests switch it on.
    os.environ["ROBONEURON_RECORDER"] = "off"
    # Images of containers often forbid compiled files. Without them each worker rewrites the
    # asserts of every test module (half of its collection), and each process compiles the project.
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out a file that is marked as a whole with what `-m` excludes: to import it and to make
    its tests only to deselect them took a seventh of each worker's collection.
    """
    expression = config.getoption("markexpr")
    if not fnmatch(collection_path.name, "test_*.py") or " or " in expression:
        return None
    excluded = set(re.findall(r"\bnot (\w+)", expression))
    marks = re.search(
        r"^pytestmark = (\[[^\]]*\]|.*)$", collection_path.read_text("utf-8"), re.MULTILINE
    )
    is_excluded = marks and excluded & set(re.findall(r"pytest\.mark\.(\w+)", marks[1]))
    return True if is_excluded else None


ROS_MODULES = pytest.StashKey[set[Path]]()
"""Files with tests that join ROS."""


# before pytest deselects by marker
@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the exhaustive cases of sampled tests; give tests that take minutes a bound of their own
    against hangs.
    """
    _leave_samples(items)
    config.stash[ROS_MODULES] = {item.path for item in items if item.get_closest_marker("ros")}
    if (seed := config.getoption("shuffle")) is not None:
        _shuffle(items, random.Random(seed))
    for item in items:
        takes_minutes = item.get_closest_marker("slow") or item.get_closest_marker("release")
        if takes_minutes and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(600))


def _leave_samples(items: list[pytest.Item]) -> None:
    """Mark all cases `exhaustive` but the first of each `every` cases of a sampled test."""
    seen: Counter[str] = Counter()
    for item in items:
        sampled = item.get_closest_marker("sampled")
        if sampled is None or item.get_closest_marker("slow"):
            continue
        test = item.nodeid.partition("[")[0]
        if seen[test] % sampled.kwargs["every"]:
            item.add_marker(pytest.mark.exhaustive)
        seen[test] += 1


def _shuffle(items: list[pytest.Item], source: random.Random) -> None:
    """Shuffle modules, and the tests within each, so that fixtures of a module are made once."""
    modules: dict[Path, list[pytest.Item]] = {}
    for item in items:
        modules.setdefault(item.path, []).append(item)
    groups = list(modules.values())
    source.shuffle(groups)
    for group in groups:
        source.shuffle(group)
    items[:] = [item for group in groups for item in group]


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
        gc.freeze()


@pytest.fixture(scope="session")
def _freeze() -> Iterator[Callable[[], None]]:
    """The function `gc.freeze`, which does nothing for modules and servers in this process.

    They freeze what they have loaded, since they live as long as their process; tests do not.
    Frozen ROS contexts are never collected: they keep their sockets, threads and shared memory.
    """
    freeze = gc.freeze
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gc, "freeze", lambda: None)
        yield freeze


@pytest.fixture(autouse=True, scope="module")
def _pauses_of_the_interpreter(
    request: pytest.FixtureRequest, _freeze: Callable[[], None]
) -> Iterator[None]:
    """Collect what a test module has left.

    What is still in use then is excluded from all later collections, which took a tenth of a second
    for each module; not where ROS contexts may be among it.
    """
    interval_s = sys.getswitchinterval()
    yield
    sys.setswitchinterval(interval_s)
    gc.collect()
    if request.path not in request.config.stash[ROS_MODULES]:
        _freeze()


@pytest.fixture(autouse=True, scope="module")
def _priority() -> Iterator[None]:
    """A test of root that leaves this process with real-time priority would slow all others."""
    if sys.platform != "linux":
        yield
        return
    before = os.sched_getscheduler(0)
    yield
    assert os.sched_getscheduler(0) == before, "a test changed the scheduling policy of its process"


@pytest.fixture
def wheels(server_environment: dict[str, str], tmp_path: Path) -> Iterator[CommandedWheels]:
    """What the wheels of the robot of `server_environment` are told."""
    from rn_testing.fakes.wheels import CommandedWheels

    prepare_environment(tmp_path / "ros")
    subscriber = CommandedWheels(int(server_environment["ROS_DOMAIN_ID"]))
    yield subscriber
    subscriber.close()


@pytest.fixture
def application_of(tmp_path: Path) -> Iterator[Callable[..., Application]]:
    """Make applications in this process that hold the fakes, `specs` and the configuration `text`.

    None of them starts a process, and none touches ROS. All are closed after the test.
    """
    from rn_testing.fakes import fake_registry
    from roboneuron.config import parse_config
    from roboneuron.server.app import Application

    made: list[Application] = []

    def make(
        *specs: Spec, text: str = '[robot]\nname = "gantry"\n', registry: Registry | None = None
    ) -> Application:
        found = registry or fake_registry(*specs)
        application = Application(
            parse_config(text, registry=found),
            plugins=lambda: found,
            directory=tmp_path / "state",
            command=lambda python: pytest.fail("nothing may be spawned"),
        )
        made.append(application)
        return application

    yield make
    for application in made:
        application.close()


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


@dataclass
class WaitingTool:
    """The tool `slow`, which works until it is cancelled.

    Attributes:
        ends: number of cancellations.
    """

    begun: threading.Event = field(default_factory=threading.Event)
    cancelled: threading.Event = field(default_factory=threading.Event)
    ends: int = 0

    async def handle(self, _: NoArguments, context: CallContext) -> Result:
        return await context.run(self._work, on_cancel=self._on_cancel)

    def _on_cancel(self) -> None:
        self.ends += 1
        self.cancelled.set()

    def _work(self, _: Any) -> Result:
        from roboneuron.server.tool import Result

        self.begun.set()
        if not self.cancelled.wait(60):
            raise StateError("Nobody cancelled it.")
        return Result()


@pytest.fixture
def waiting_tool(application: Application) -> WaitingTool:
    """Give the application of the test the tool `slow`."""
    from roboneuron.server.tool import NoArguments, Result, Tool

    tool = WaitingTool()
    listed = Tool(
        name="slow",
        title="s",
        description="s",
        arguments=NoArguments,
        result=Result,
        handler=tool.handle,
    )
    application.tools.add_all([listed])
    return tool

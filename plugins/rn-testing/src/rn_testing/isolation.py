"""pytest plugin: a test run touches nothing of the person who starts it.

Each process of the run has a home of its own, and an environment without the person's settings.
Where the kernel has Landlock (Linux 6.2), it refuses every write to the person's home, and every
look at the folders of RoboNeuron and ROS there, by tests and by all that they start: a test that
forgets to say where something belongs fails with PermissionError. Whatever mounts file systems
needs `run_unguarded`, or a run with `--unguarded`.
"""

from __future__ import annotations

import json
import os
import pwd
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping, MutableMapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import pytest

from rn_testing.landlock import WriteBounds, is_available, restrict_thread

T = TypeVar("T")
KEPT = frozenset(
    f"ROBONEURON_{name}"
    for name in (
        "CUTS",
        "EVAL_KILLS",
        "FR3SIM_PYTHON",
        "FUZZ_CALLS",
        "LIBERO_PYTHON",
        "OPENPI",
        "OPENPI_CLIENT_PYTHON",
        "ROBOARENA",
        "VLA_EVAL_PYTHON",
    )
)
"""Variables that lanes give to tests."""
_PREFIXES = (
    *("ROBONEURON_", "ROS_", "RCUTILS_", "RCL_", "RMW_", "AMENT_", "COLCON_", "XDG_"),
    *("FASTRTPS_", "FASTDDS_", "CYCLONEDDS_", "OTEL_", "MCP_", "FASTMCP_"),
)
_NAMES = frozenset(
    (
        *("PYTHONPATH", "PYTHONSTARTUP", "PYTHONUSERBASE", "PYTHONWARNINGS", "PYTHONOPTIMIZE"),
        *("PYTHONUNBUFFERED", "PYTHONSAFEPATH", "PYTHONIOENCODING", "PYTHONPYCACHEPREFIX"),
        *("NO_COLOR", "FORCE_COLOR", "CLICOLOR", "CLICOLOR_FORCE", "COLUMNS", "LINES"),
        *("PAGER", "EDITOR", "VISUAL", "BROWSER", "DBUS_SESSION_BUS_ADDRESS"),
    )
)
_XDG = {"STATE": ".local/state", "DATA": ".local/share", "CONFIG": ".config", "CACHE": ".cache"}
_PRODUCT = "roboneuron"
_TOOLS = {
    "PIP_CONFIG_FILE": (".config/pip/pip.conf", ".pip/pip.conf"),
    "PLAYWRIGHT_BROWSERS_PATH": (".cache/ms-playwright",),
    "PYENV_ROOT": (".pyenv",),
}
"""Where tools of lanes find what is installed in the person's home; only read."""
_LOOPBACK = "localhost,127.0.0.1,::1"
_GIT = "[user]\n\tname = Test\n\temail = test@example.com\n[safe]\n\tdirectory = *\n"


def is_personal(name: str) -> bool:
    """True for an environment variable that tests must not see."""
    return (name.startswith(_PREFIXES) or name in _NAMES) and name not in KEPT


def persons_bounds(environment: Mapping[str, str], writable: Mapping[str, Path]) -> WriteBounds:
    """What belongs to the person with this environment, except the `writable` folders."""
    homes = {
        Path(name).resolve()
        for name in (environment.get("HOME", ""), pwd.getpwuid(os.getuid()).pw_dir)
        if name and Path(name).is_dir() and Path(name).resolve() != Path("/")
    }
    folders = {home / ".ros" for home in homes}
    for name, usual in _XDG.items():
        folders |= {home / usual / _PRODUCT for home in homes}
        if own := environment.get(f"XDG_{name}_HOME"):
            folders.add(Path(own).resolve() / _PRODUCT)
    if own := environment.get("XDG_RUNTIME_DIR"):
        folders.add(Path(own).resolve() / _PRODUCT)
    return WriteBounds(
        read_only=frozenset(homes | folders),
        hidden=frozenset(folders),
        writable=frozenset(path.resolve() for path in writable.values()),
    )


def move_in(environment: MutableMapping[str, str], home: Path) -> None:
    """Change an environment into that of somebody with an empty `home`, which is made."""
    old = Path(environment.get("HOME") or pwd.getpwuid(os.getuid()).pw_dir)
    for name in [name for name in environment if is_personal(name)]:
        del environment[name]
    for name, places in _TOOLS.items():
        found = next((old / place for place in places if (old / place).exists()), None)
        if found is not None:
            environment.setdefault(name, str(found))
    (home / "run").mkdir(parents=True, mode=0o700)
    (home / ".gitconfig").write_text(_GIT, encoding="utf-8")
    environment.update(
        HOME=str(home),
        XDG_RUNTIME_DIR=str(home / "run"),
        GIT_CONFIG_GLOBAL=str(home / ".gitconfig"),
        MPLCONFIGDIR=str(home.parent / "matplotlib"),
    )
    for name in ("NO_PROXY", "no_proxy"):
        environment[name] = ",".join(filter(None, (environment.get(name, ""), _LOOPBACK)))


class Isolation:
    """Home and guard of one process of a test run."""

    def __init__(self, config: pytest.Config) -> None:
        given: Mapping[str, Any] | None = getattr(config, "workerinput", None)
        self._folder: Path | None = None
        if given is None:
            self.person = {
                name: value
                for name, value in os.environ.items()
                if name == "HOME" or name.startswith("XDG_")
            }
            self.folder = self._folder = Path(tempfile.mkdtemp(prefix="rn-home-"))
        else:
            self.person = json.loads(given["person"])
            self.folder = Path(given["folder"])
        # before the guard, so that this thread is free of it
        self._free = ThreadPoolExecutor(1, "unguarded")
        self._free.submit(int).result()
        added = os.environ.get("PYTHONPATH", "").split(os.pathsep)
        sys.path[:] = [path for path in sys.path if not path or path not in added]
        move_in(os.environ, self.folder / (given["workerid"] if given is not None else "main"))
        starts_tests = given is not None or config.getoption("dist", "no") == "no"
        self.is_wanted = not config.getoption("unguarded")
        self.is_guarded = self.is_wanted and starts_tests and is_available()
        if self.is_guarded:
            writable = {
                "repository": config.rootpath,
                "virtual environment": Path(sys.prefix),
                "temporary": Path(tempfile.gettempdir()),
                "run": self.folder,
            }
            if basetemp := config.getoption("basetemp"):
                writable["basetemp"] = Path(basetemp).absolute().parent
            restrict_thread(persons_bounds(self.person, writable))

    def run_unguarded(self, function: Callable[[], T]) -> T:
        """Call a function in a thread that is free of the guard; return its result."""
        return self._free.submit(function).result()

    def close(self) -> None:
        """Remove the homes of the run."""
        self._free.shutdown()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)


_KEY = pytest.StashKey[Isolation]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option."""
    parser.addoption(
        "--unguarded",
        action="store_true",
        help="do not forbid writes to your home, for tests that mount file systems",
    )


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Give this process a home, and guard that of the person."""
    config.stash[_KEY] = Isolation(config)


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    """Tell a worker of pytest-xdist whose home it is, which its environment no longer tells."""
    isolation = node.config.stash[_KEY]
    node.workerinput["person"] = json.dumps(isolation.person)
    node.workerinput["folder"] = str(isolation.folder)


def pytest_report_header(config: pytest.Config) -> str:
    """Say whether the guard works here."""
    if not config.stash[_KEY].is_wanted:
        return "home: one of this run; writes to yours are not forbidden (--unguarded)"
    if not is_available():
        return "home: one of this run; writes to yours are not forbidden (no Landlock here)"
    return "home: one of this run; writes to yours are forbidden"


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """Remove the homes."""
    config.stash[_KEY].close()


@pytest.fixture(scope="session")
def run_unguarded(request: pytest.FixtureRequest) -> Callable[[Callable[[], Any]], Any]:
    """Return a function that calls another one where file systems can be mounted."""
    isolation: Isolation = request.config.stash[_KEY]
    return isolation.run_unguarded


def is_guarded(config: pytest.Config) -> bool:
    """True if writes are forbidden to tests of this process."""
    return config.stash[_KEY].is_guarded

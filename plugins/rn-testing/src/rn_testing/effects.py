"""Side effects of code: files, sockets, processes, threads, processor time."""

from __future__ import annotations

import functools
import gc
import itertools
import os
import sys
import tempfile
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar, cast

from rn_testing.rule import NotApplicable, Violation
from rn_testing.waiting import holds_within
from roboneuron import RoboNeuronError

T = TypeVar("T")

HEAVY_MODULES = ("torch", "transformers", "tensorflow", "jax", "pybullet", "mujoco", "pinocchio")
"""Modules whose import is so slow that it belongs into `load` or `open`."""
PURE_CPU_S = 0.5
"""Processor time allowed to a constructor; generous, because forbidden work takes seconds."""
MANY, QUICK_S, ROUND_S, TRIES = 200, 0.001, 0.25, 3
"""Maximum number of calls per round of the memory check; duration below which a call always gets
that many; maximum duration of a round of slower calls (unless the minimum count takes longer);
number of timed calls.
"""
RELEASE_S = 3.0
"""Time in which closed threads and processes must end."""
ROUNDS = 4
"""Rounds of the memory check; the first may fill caches, and one round without growth is enough."""
OPEN_FILES = 0.05
"""Open files allowed per call, because other threads open some meanwhile."""
LEAK_BYTES, SLOW_LEAK_BYTES, RESIDENT_LEAK_BYTES = 256, 2048, 100_000
"""Bytes that may stay allocated per call: with MANY calls; with the minimum number of calls (whose
bounded histories are still filling); and of memory outside Python's allocator. Lower values are
noise. Noise is per round, so more calls reveal smaller leaks.
"""

_EVENTS = {
    "open": "opens the file",
    "socket.connect": "connects to",
    "socket.bind": "binds",
    "subprocess.Popen": "starts the process",
    "os.posix_spawn": "starts the process",
    "os.fork": "forks",
    "os.system": "runs the command",
    # since Python 3.12; earlier, only threads that persist are detected
    "_thread.start_new_thread": "starts the thread",
}
_IMPORT_SUFFIXES = (".py", ".pyc", ".so")
_BYTECODE = "__pycache__"
"""Folder in which the first import writes bytecode, under a temporary name."""
_observed: ContextVar[list[str] | None] = ContextVar("observed_effects", default=None)
_marks: ContextVar[Marks | None] = ContextVar("marks", default=None)


def find_effects(action: Callable[[], T]) -> tuple[T, list[str]]:
    """Run `action` in this thread; return its result and a sentence part for each effect."""
    _install_hook()
    effects: list[str] = []
    loaded = set(sys.modules)
    threads = _threads()
    started_s = time.thread_time()
    token = _observed.set(effects)
    try:
        result = action()
    finally:
        _observed.reset(token)
    spent_s = time.thread_time() - started_s
    effects += [
        f"imports {name}" for name in HEAVY_MODULES if name in sys.modules and name not in loaded
    ]
    if not effects and not _threads() <= threads:  # a thread of someone else may end meanwhile
        effects.append("starts threads")
    if spent_s > PURE_CPU_S:
        effects.append(f"computes for {spent_s:.1f} s")
    return result, effects


@functools.cache
def _install_hook() -> None:
    """Install the audit hook once, because hooks cannot be removed; it is active only inside
    `find_effects`.
    """
    sys.addaudithook(_audit)


@dataclass(slots=True)
class Marks:
    """What one thread does to its process and to files around it, as the interpreter reports it.

    An action is recorded when it happens, also if it sets what is set already or is undone later:
    the state before and after it would be the same.

    Attributes:
        created: new files and folders of the temporary folder.
        written: files and folders of the working folder that were written.
        folders: working folders that were set.
        variables: environment variables that were set or removed.
    """

    folder: Path
    created: list[Path] = field(default_factory=list)
    written: list[Path] = field(default_factory=list)
    folders: list[str] = field(default_factory=list)
    variables: list[str] = field(default_factory=list)

    def note(self, event: str, arguments: tuple[object, ...]) -> None:
        """Record an audit event. Source: the Python documentation, "Audit events table"."""
        if event == "os.chdir":
            self.folders.append(str(arguments[0]))
        elif event in ("os.putenv", "os.unsetenv"):
            self.variables.append(os.fsdecode(cast("bytes | str", arguments[0])))
        elif event in ("tempfile.mkdtemp", "tempfile.mkstemp"):
            self.created.append(Path(str(arguments[0])))
        elif event == "os.mkdir" or (event == "open" and _writes(arguments[2])):
            self._note_path(arguments[0])

    def _note_path(self, name: object) -> None:
        if not isinstance(name, (str, bytes, os.PathLike)):
            return
        path = Path(os.fsdecode(name)).absolute()
        if _BYTECODE in path.parts:
            return
        temporary = Path(tempfile.gettempdir())
        is_deeper = self.folder != temporary and self.folder.is_relative_to(temporary)
        is_here = path.is_relative_to(self.folder)
        if is_here and (is_deeper or not path.is_relative_to(temporary)):
            self.written.append(path)
        elif path.is_relative_to(temporary) and not path.exists():
            self.created.append(path)


def _writes(flags: object) -> bool:
    return isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))


@contextmanager
def watch_marks() -> Iterator[Marks]:
    """Record what this thread does to the process and to files."""
    _install_hook()
    # the first call writes a file, which must not happen inside the hook
    tempfile.gettempdir()
    marks = Marks(Path.cwd())
    token = _marks.set(marks)
    try:
        yield marks
    finally:
        _marks.reset(token)


def _audit(event: str, arguments: tuple[object, ...]) -> None:
    marks = _marks.get()
    if marks is not None:
        marks.note(event, arguments)
    effects = _observed.get()
    if effects is None or event not in _EVENTS:
        return
    subject = str(arguments[0]) if arguments else ""
    if event == "open" and (subject.isdigit() or subject.endswith(_IMPORT_SUFFIXES)):
        return
    if _BYTECODE in subject.split(os.sep):
        return
    effects.append(f"{_EVENTS[event]} {subject}".strip())


def _threads() -> frozenset[str]:
    tasks = Path("/proc/self/task")
    if tasks.is_dir():
        return frozenset(task.name for task in tasks.iterdir())
    return frozenset(str(thread.ident) for thread in threading.enumerate())


def expect_refusal(action: Callable[[], object], what: str, *kinds: type[RoboNeuronError]) -> None:
    """Raise Violation unless `action` raises one of `kinds` (any RoboNeuronError if none are
    given).
    """
    expected = kinds or (RoboNeuronError,)
    names = " or ".join(k.__name__ for k in expected)
    try:
        result = action()
    except expected:
        return
    except NotApplicable:
        raise
    except Exception as error:
        raise Violation(
            f"{what} raised {type(error).__name__}: {error}; expected {names}"
        ) from error
    raise Violation(f"{what} returned {_short(result)}, expected {names}")


def within(limit_s: float, action: Callable[[], T], what: str) -> T:
    """Return the result of `action`; raise Violation if it takes longer than `limit_s`, its own
    errors otherwise.

    It runs in a daemon thread, which is abandoned if it hangs.
    """
    outcome: list[T] = []
    errors: list[BaseException] = []

    def work() -> None:
        try:
            outcome.append(action())
        except BaseException as error:  # raised in the caller below
            errors.append(error)

    thread = threading.Thread(target=work, name="contract-rule", daemon=True)
    thread.start()
    thread.join(limit_s)
    if thread.is_alive():
        raise Violation(f"{what} did not return within {limit_s:g} s")
    if errors:
        raise errors[0]
    return outcome[0]


def running() -> frozenset[str]:
    """Names of running Python threads and child processes, which a closed plugin must not leave
    behind.
    """
    threads = {
        f"thread {t.name} ({t.native_id})"
        for t in threading.enumerate()
        if t is not threading.current_thread()
    }
    children: set[str] = set()
    for listing in Path("/proc/self/task").glob("*/children"):
        try:
            children |= {f"process {pid}" for pid in listing.read_text().split()}
        except OSError:  # the thread has ended meanwhile
            continue
    return frozenset(threads | children)


def open_files() -> frozenset[str]:
    """Open files, sockets and pipes of this process, each with its number."""
    found: set[str] = set()
    folder = Path("/proc/self/fd")
    for entry in folder.iterdir() if folder.is_dir() else ():
        try:
            found.add(f"{entry.name} {entry.readlink()}")
        except OSError:  # the descriptor of this listing, and files that other threads close
            continue
    return frozenset(found)


def check_releases(run: Callable[[], object], what: str) -> None:
    """Raise Violation if `run` leaves threads, processes or open files, while its result is kept.

    Files that stay open are checked a second time, because libraries open some once per process.
    """
    before = running()
    for trial in range(2):
        files = open_files()
        kept = run()
        check_released(before, what)
        if holds_within(lambda files=files: open_files() <= files, RELEASE_S):  # type: ignore[misc]
            return
        left = sorted(open_files() - files)
        if trial:
            raise Violation(f"{what} leaves open: {', '.join(left)}")
        del kept


def check_released(before: frozenset[str], what: str) -> None:
    """Raise Violation if threads or child processes that are not in `before` still exist after
    RELEASE_S.
    """
    if not holds_within(lambda: running() <= before, RELEASE_S):
        raise Violation(f"{what} leaves behind: {', '.join(sorted(running() - before))}")


def check_quick(limit_s: float, action: Callable[[], object], what: str, *, tries: int = 3) -> None:
    """Raise Violation unless the quickest of some calls takes at most `limit_s`; a busy machine
    slows single calls, not all.
    """

    def timed_s() -> float:
        begun_s = time.perf_counter()
        action()
        return time.perf_counter() - begun_s

    quickest_s = min_until(timed_s, limit_s, tries=tries)
    if quickest_s > limit_s:
        raise Violation(f"{what} takes {quickest_s:.3g} s, at most {limit_s:g} s are allowed")


def min_until(measure_s: Callable[[], float], limit_s: float, *, tries: int = 3) -> float:
    """Smallest result of `measure_s`, which is repeated until one is within the limit."""
    quickest_s = float("inf")
    while tries and quickest_s > limit_s:
        quickest_s, tries = min(quickest_s, measure_s()), tries - 1
    return quickest_s


def check_memory(action: Callable[[], object], what: str, *, count: int = 20) -> None:
    """Raise Violation if memory or the number of open files grows with every call, in each round
    after the first, which fills caches.

    Args:
        action: the call.
        what: its name.
        count: minimum calls per round; quick actions are called MANY times, which fills bounded
            histories.
    """
    times_s = []
    for _ in range(TRIES):
        begun_s = time.perf_counter()
        action()
        times_s.append(time.perf_counter() - begun_s)
    # some may have been buffered or interrupted
    typical_s = sorted(times_s)[TRIES // 2]
    calls = MANY if typical_s < QUICK_S else max(count, min(MANY, int(ROUND_S / typical_s)))
    python_bytes = LEAK_BYTES if calls >= MANY else max(LEAK_BYTES, SLOW_LEAK_BYTES * count / calls)
    marks: list[tuple[int, int, int]] = []
    allowed = (python_bytes, RESIDENT_LEAK_BYTES, OPEN_FILES)
    tracemalloc.start(1)
    try:
        for _ in range(ROUNDS):
            for _ in range(calls):
                action()
            gc.collect()
            marks.append((tracemalloc.get_traced_memory()[0], _resident_bytes(), len(open_files())))
            kept = _kept_by_each_call(marks, calls)
            if kept is not None and (
                all(k <= most for k, most in zip(kept, allowed, strict=True)) or kept[2] > 0.5
            ):
                # one round without growth suffices, and a process cannot hold more leaked files
                break
    finally:
        tracemalloc.stop()
    assert kept is not None
    if kept[2] > OPEN_FILES:
        raise Violation(f"{what} leaves {kept[2]:.2g} more files open with each call")
    for value, most in zip(kept[:2], allowed, strict=False):
        if value > most:
            raise Violation(f"{what} leaks about {value:.0f} bytes of memory with each call")


def _kept_by_each_call(marks: list[tuple[int, int, int]], calls: int) -> tuple[float, ...] | None:
    """Smallest growth over the rounds, per call; None after the first round."""
    if len(marks) < 2:
        return None
    return tuple(
        min(later - sooner for sooner, later in itertools.pairwise(each)) / calls
        for each in zip(*marks, strict=True)
    )


def _resident_bytes() -> int:
    status = Path("/proc/self/statm")
    return int(status.read_text().split()[1]) * os.sysconf("SC_PAGESIZE") if status.is_file() else 0


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."

"""State of the whole process, which no plugin may change: folder, environment, signals, random
generators.

A difference after a plugin was built, started, used and closed is tested a second time, because
what libraries do once per process, at import, does not recur.
"""

from __future__ import annotations

import atexit
import gc
import locale
import logging
import os
import random
import signal
import socket
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any, Generic, TextIO, TypeVar

import numpy as np

from rn_testing.effects import Marks, watch_marks

LIBRARY_VARIABLES = (
    "OPENCV_",
    "OMP_",
    "MKL_",
    "KMP_",
    "OPENBLAS_",
    "CUDA_",
    "MUJOCO_",
    "PYOPENGL_",
    "TOKENIZERS_",
)
"""Prefixes of environment variables of native libraries that cannot be configured otherwise."""
_SEEDS = (20_011, 40_013)
"""Seeds of the global generators in the two trials: a plugin that only draws ends in different
states.
"""


T = TypeVar("T")
Handlers = dict[signal.Signals, "Callable[[int, FrameType | None], object] | int | None"]
Hooks = tuple["Callable[..., object]", "Callable[..., object]"]


@dataclass(frozen=True, slots=True)
class _Aspect(Generic[T]):
    """One part of the state: its name, and functions to read and restore it.

    Attributes:
        unusual: values that no plugin sets, one of which stands before a trial: a plugin that was
            built before has set its own already, and would change nothing.
    """

    name: str
    read: Callable[[], T]
    restore: Callable[[T], object]
    unusual: tuple[T, ...] = ()


def _environment() -> dict[str, str]:
    return {
        name: text
        for name, text in os.environ.items()
        if not name.startswith((*LIBRARY_VARIABLES, "PYTEST_"))
    }


def _restore_environment(before: dict[str, str]) -> None:
    for name in _environment().keys() - before.keys():
        del os.environ[name]
    os.environ.update(before)


def _umask() -> int:
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.is_file() else []
    return next((int(line.split()[1], 8) for line in lines if line.startswith("Umask:")), 0)


def _logging() -> tuple[tuple[logging.Handler, ...], int, int]:
    root = logging.getLogger()
    return tuple(root.handlers), root.level, logging.root.manager.disable


def _restore_logging(before: tuple[tuple[logging.Handler, ...], int, int]) -> None:
    root = logging.getLogger()
    root.handlers[:], root.level, logging.root.manager.disable = before


def _torch() -> ModuleType | None:
    return sys.modules.get("torch")  # only if a plugin has loaded it


def _torch_defaults() -> tuple[object, ...]:
    torch = _torch()
    return () if torch is None else (torch.get_default_dtype(), torch.is_grad_enabled())


def _restore_torch_defaults(before: tuple[object, ...]) -> None:
    torch = _torch()
    if before and torch is not None:
        torch.set_default_dtype(before[0])
        torch.set_grad_enabled(before[1])


def _restore_handlers(before: Handlers) -> None:
    with suppress(ValueError):  # rules run in a thread, where no handler can have been set
        for number, handler in before.items():
            if signal.getsignal(number) is not handler:
                signal.signal(number, handler)


def _restore_path(before: tuple[str, ...]) -> None:
    sys.path[:] = before


def _restore_filters(before: tuple[object, ...]) -> None:
    warnings.filters[:] = before  # type: ignore[index]
    getattr(warnings, "_filters_mutated", int)()


def _restore_streams(before: tuple[TextIO, TextIO]) -> None:
    sys.stdout, sys.stderr = before


def _is_closed(stream: TextIO | None) -> bool:
    return stream is None or stream.closed


def _restore_hooks(before: Hooks) -> None:
    sys.excepthook, threading.excepthook = before


_ASPECTS: tuple[_Aspect[Any], ...] = (
    _Aspect("the working folder", os.getcwd, os.chdir),
    _Aspect("the environment", _environment, _restore_environment),
    _Aspect(
        "signal handlers",
        lambda: {n: signal.getsignal(n) for n in signal.valid_signals()},
        _restore_handlers,
    ),
    _Aspect("the umask", _umask, os.umask, (0o027, 0o037)),
    _Aspect(
        "the locale",
        lambda: locale.setlocale(locale.LC_ALL),
        lambda v: locale.setlocale(locale.LC_ALL, v),
    ),
    _Aspect(
        "the default time-out of sockets",
        socket.getdefaulttimeout,
        socket.setdefaulttimeout,
        (977.0, 983.0),
    ),
    _Aspect("sys.path", lambda: tuple(sys.path), _restore_path),
    _Aspect("hooks for exceptions", lambda: (sys.excepthook, threading.excepthook), _restore_hooks),
    _Aspect("the recursion limit", sys.getrecursionlimit, sys.setrecursionlimit, (2003, 2011)),
    _Aspect("the root logger", _logging, _restore_logging),
    _Aspect("the filters of warnings", lambda: tuple(warnings.filters), _restore_filters),
    _Aspect("NumPy's handling of errors", np.geterr, lambda v: np.seterr(**v)),
    _Aspect("NumPy's print options", np.get_printoptions, lambda v: np.set_printoptions(**v)),
    _Aspect(
        "garbage collection",
        gc.isenabled,
        lambda on: gc.enable() if on else gc.disable(),
        (True, True),
    ),
    _Aspect("exit handlers", lambda: getattr(atexit, "_ncallbacks", int)(), lambda v: None),
    _Aspect("standard streams", lambda: (sys.stdout, sys.stderr), _restore_streams),
    _Aspect("standard input", lambda: (sys.stdin, _is_closed(sys.stdin)), lambda before: None),
    _Aspect("PyTorch's defaults", _torch_defaults, _restore_torch_defaults),
)


def _generators() -> dict[str, Callable[[], bytes]]:
    """State of each global random generator."""
    found = {
        "random": lambda: repr(random.getstate()).encode(),
        "numpy.random": lambda: (
            repr(np.random.get_state(legacy=False)).encode() + np.random.get_state()[1].tobytes()  # type: ignore[index]
        ),
    }
    torch = _torch()
    if torch is not None:
        found["torch"] = lambda: str(torch.initial_seed()).encode()  # drawing does not change it
    return found


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Seed the global generators, and restore them at the end."""
    torch = _torch()
    python, numpy = random.getstate(), np.random.get_state()
    pytorch = None if torch is None else torch.get_rng_state()
    random.seed(seed)
    np.random.seed(seed)
    if torch is not None:
        torch.manual_seed(seed)
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)
        if torch is not None:
            torch.set_rng_state(pytorch)


@contextmanager
def _watched_handlers(asked: list[str]) -> Iterator[None]:
    """Record in `asked` the signals for which a handler is set; in the rules' thread Python would
    refuse it.
    """
    real = signal.signal

    def note(number: int, handler: object) -> object:
        asked.append(signal.Signals(number).name)
        return signal.getsignal(number)

    signal.signal = note  # type: ignore[assignment]
    try:
        yield
    finally:
        signal.signal = real


@contextmanager
def _watched_output(printed: list[str]) -> Iterator[None]:
    """Append to `printed` everything written to standard output, including that of C libraries and
    processes.
    """
    sys.stdout.flush()
    kept = os.dup(1)
    stream = sys.stdout
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 1)
        written = open(os.dup(1), "w", encoding="utf-8", errors="replace")  # noqa: SIM115
        sys.stdout = written
        try:
            yield
        finally:
            written.flush()
            if sys.stdout is written:
                sys.stdout = stream
            os.dup2(kept, 1)
            os.close(kept)
            written.close()
            file.seek(0)
            text = file.read().decode("utf-8", errors="replace").strip()
            if text:
                printed.append(text)


@dataclass(frozen=True, slots=True)
class _Trial:
    """Changes in one trial: sentence parts, and the final states of generators that moved."""

    changes: tuple[str, ...]
    generators: dict[str, bytes]


def _try(action: Callable[[], object], trial: int) -> _Trial:
    asked: list[str] = []
    printed: list[str] = []
    before = [aspect.read() for aspect in _ASPECTS]
    changes: list[str] = []
    try:
        for aspect in _ASPECTS:
            if aspect.unusual:
                aspect.restore(aspect.unusual[trial])
        with _seeded(_SEEDS[trial]):
            begun = {name: read() for name, read in _generators().items()}
            with watch_marks() as marks, _watched_handlers(asked), _watched_output(printed):
                within = [aspect.read() for aspect in _ASPECTS]
                action()
                after = [aspect.read() for aspect in _ASPECTS]
            ended = {name: read() for name, read in _generators().items() if name in begun}
    finally:
        for aspect, old in zip(_ASPECTS, before, strict=True):
            if aspect.read() != old:
                aspect.restore(old)
    changes += [
        f"changes {aspect.name}{_difference(then, now)}"
        for aspect, then, now in zip(_ASPECTS, within, after, strict=True)
        if now != then
    ]
    changes += _marked(marks, {change.partition(" (")[0] for change in changes})
    changes += [f"sets a handler for {name}" for name in dict.fromkeys(asked)]
    changes += [f"writes to standard output ({text[:60]!r})" for text in printed]
    return _Trial(
        tuple(changes), {name: state for name, state in ended.items() if state != begun[name]}
    )


def _marked(marks: Marks, known: set[str]) -> list[str]:
    """Changes that a comparison of the state before and after does not show."""
    variables = sorted(
        {name for name in marks.variables if not name.startswith((*LIBRARY_VARIABLES, "PYTEST_"))}
    )
    found = {
        "changes the working folder": marks.folders,
        "changes the environment": variables,
        "writes into the working folder": [str(path) for path in marks.written],
    }
    told = [
        f"{change} ({', '.join(dict.fromkeys(items))[:80]})"
        for change, items in found.items()
        if items and change not in known
    ]
    return told + [f"leaves {path}" for path in marks.created if path.exists()]


def _difference(then: object, now: object) -> str:
    if not (isinstance(then, dict) and isinstance(now, dict)):
        return ""
    names = sorted(str(k) for k in then.keys() | now.keys() if then.get(k) != now.get(k))
    return f" ({', '.join(names)[:80]})"


def find_changes(action: Callable[[], object]) -> list[str]:
    """Run `action` in this thread, once or twice; return a sentence part for each change that
    occurs every time.
    """
    first = _try(action, 0)
    if not first.changes and not first.generators:
        return []
    second = _try(action, 1)
    kinds = {change.partition(" (")[0] for change in second.changes}
    leaves = any(change.startswith("leaves ") for change in second.changes)
    changes = [
        c
        for c in first.changes
        if c.partition(" (")[0] in kinds or (leaves and c.startswith("leaves "))
    ]
    seeded = [
        name for name, state in first.generators.items() if second.generators.get(name) == state
    ]
    return changes + [f"seeds the global generator of {name}" for name in seeded]

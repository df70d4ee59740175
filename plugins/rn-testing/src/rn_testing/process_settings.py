"""Settings of the whole process, each with how to read and how to restore it."""

from __future__ import annotations

import asyncio
import atexit
import functools
import gc
import importlib
import locale
import logging
import multiprocessing
import os
import resource
import signal
import socket
import sys
import threading
import urllib.request
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any, Generic, TextIO, TypeVar

import numpy as np

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
_SHARED_MODULES = (
    *("builtins", "json", "logging", "math", "os", "random", "socket", "ssl", "subprocess"),
    *("tempfile", "threading", "time", "warnings", "urllib.request"),
    *("numpy", "numpy.linalg", "numpy.random", "roboneuron", "roboneuron.contract"),
)
"""Modules whose functions and classes every plugin of the process uses."""
_CORE = "roboneuron"

T = TypeVar("T")
Handlers = dict[signal.Signals, "Callable[[int, FrameType | None], object] | int | None"]
Hooks = tuple["Callable[..., object]", "Callable[..., object]"]


@dataclass(frozen=True, slots=True)
class ProcessSetting(Generic[T]):
    """One setting: its name, and functions to read and restore it.

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


def loaded_torch() -> ModuleType | None:
    """PyTorch, if a plugin has loaded it."""
    return sys.modules.get("torch")


def _torch_defaults() -> tuple[object, ...]:
    torch = loaded_torch()
    return () if torch is None else (torch.get_default_dtype(), torch.is_grad_enabled())


def _restore_torch_defaults(before: tuple[object, ...]) -> None:
    torch = loaded_torch()
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


@functools.cache
def _shared_names() -> tuple[tuple[ModuleType, str], ...]:
    """Functions and classes of shared modules; what a module loads later is not watched."""
    modules = [importlib.import_module(name) for name in _SHARED_MODULES]
    return tuple(
        (module, name) for module in modules for name, v in vars(module).items() if callable(v)
    )


def _shared() -> dict[str, object]:
    return {f"{module.__name__}.{name}": getattr(module, name) for module, name in _shared_names()}


def _restore_shared(before: dict[str, object]) -> None:
    for module, name in _shared_names():
        setattr(module, name, before[f"{module.__name__}.{name}"])


def _warnings_logged() -> bool:
    return vars(logging)["_warnings_showwarning"] is not None


def _core_loggers() -> dict[str, tuple[object, ...]]:
    """Settings of the loggers of the core that exist."""
    logging.getLogger(_CORE)
    return {
        name: (logger.level, logger.disabled, logger.propagate, *logger.handlers, *logger.filters)
        for name, logger in list(logging.root.manager.loggerDict.items())
        if name.partition(".")[0] == _CORE and isinstance(logger, logging.Logger)
    }


def _restore_core_loggers(before: dict[str, tuple[object, ...]]) -> None:
    for name, (level, disabled, propagate, *_) in before.items():
        logger = logging.getLogger(name)
        logger.level, logger.disabled, logger.propagate = level, disabled, propagate  # type: ignore[assignment]
    logging.root.manager._clear_cache()  # type: ignore[attr-defined]


def _limits() -> dict[str, tuple[int, int]]:
    names = [name for name in dir(resource) if name.startswith("RLIMIT_")]
    return {name: resource.getrlimit(getattr(resource, name)) for name in names}


def _restore_limits(before: dict[str, tuple[int, int]]) -> None:
    for name, limits in before.items():
        with suppress(OSError, ValueError):  # a hard limit that was lowered
            resource.setrlimit(getattr(resource, name), limits)


def _priority() -> int:
    return os.getpriority(os.PRIO_PROCESS, 0)


def _restore_priority(before: int) -> None:
    with suppress(OSError):  # only the administrator may raise it again
        os.setpriority(os.PRIO_PROCESS, 0, before)


def _start_method() -> str:
    chosen = multiprocessing.get_start_method(allow_none=True)
    return chosen or multiprocessing.get_all_start_methods()[0]


def _restore_tracing(before: tuple[Any, Any]) -> None:
    threading.settrace(before[0])
    threading.setprofile(before[1])


def _is_closed(stream: TextIO | None) -> bool:
    return stream is None or stream.closed


def _restore_hooks(before: Hooks) -> None:
    sys.excepthook, threading.excepthook = before


SETTINGS: tuple[ProcessSetting[Any], ...] = (
    ProcessSetting("the working folder", os.getcwd, os.chdir),
    ProcessSetting("the environment", _environment, _restore_environment),
    ProcessSetting(
        "signal handlers",
        lambda: {n: signal.getsignal(n) for n in signal.valid_signals()},
        _restore_handlers,
    ),
    ProcessSetting("the umask", _umask, os.umask, (0o027, 0o037)),
    ProcessSetting(
        "the locale",
        lambda: locale.setlocale(locale.LC_ALL),
        lambda v: locale.setlocale(locale.LC_ALL, v),
    ),
    ProcessSetting(
        "the default time-out of sockets",
        socket.getdefaulttimeout,
        socket.setdefaulttimeout,
        (977.0, 983.0),
    ),
    ProcessSetting("sys.path", lambda: tuple(sys.path), _restore_path),
    ProcessSetting(
        "hooks for exceptions", lambda: (sys.excepthook, threading.excepthook), _restore_hooks
    ),
    ProcessSetting(
        "the recursion limit", sys.getrecursionlimit, sys.setrecursionlimit, (2003, 2011)
    ),
    ProcessSetting("the root logger", _logging, _restore_logging),
    ProcessSetting("the filters of warnings", lambda: tuple(warnings.filters), _restore_filters),
    ProcessSetting(
        "whether warnings are logged", _warnings_logged, logging.captureWarnings, (False, False)
    ),
    ProcessSetting("functions of other modules", _shared, _restore_shared),
    ProcessSetting("loggers of the core", _core_loggers, _restore_core_loggers),
    ProcessSetting("limits of the process", _limits, _restore_limits),
    ProcessSetting("its priority", _priority, _restore_priority),
    ProcessSetting(
        "the processors it runs on",
        lambda: os.sched_getaffinity(0),
        lambda v: os.sched_setaffinity(0, v),
    ),
    ProcessSetting(
        "the switch interval of threads",
        sys.getswitchinterval,
        sys.setswitchinterval,
        (0.004, 0.006),
    ),
    ProcessSetting("the stack size of threads", threading.stack_size, threading.stack_size),
    ProcessSetting(
        "tracing of threads",
        lambda: (threading.gettrace(), threading.getprofile()),
        _restore_tracing,
    ),
    ProcessSetting(
        "the policy of event loops", asyncio.get_event_loop_policy, asyncio.set_event_loop_policy
    ),
    ProcessSetting(
        "how processes start",
        _start_method,
        lambda v: multiprocessing.set_start_method(v, force=True),
    ),
    # not restored: `urlopen` makes one where there is none, which is no change the second time
    ProcessSetting("the opener of URLs", lambda: vars(urllib.request)["_opener"], lambda v: None),
    ProcessSetting("NumPy's handling of errors", np.geterr, lambda v: np.seterr(**v)),
    ProcessSetting(
        "NumPy's print options", np.get_printoptions, lambda v: np.set_printoptions(**v)
    ),
    ProcessSetting(
        "garbage collection",
        gc.isenabled,
        lambda on: gc.enable() if on else gc.disable(),
        (True, True),
    ),
    ProcessSetting(
        "thresholds of garbage collection",
        gc.get_threshold,
        lambda v: gc.set_threshold(*v),
        ((701, 11, 11), (702, 12, 12)),
    ),
    ProcessSetting("exit handlers", lambda: getattr(atexit, "_ncallbacks", int)(), lambda v: None),
    ProcessSetting("standard streams", lambda: (sys.stdout, sys.stderr), _restore_streams),
    ProcessSetting(
        "standard input", lambda: (sys.stdin, _is_closed(sys.stdin)), lambda before: None
    ),
    ProcessSetting("PyTorch's defaults", _torch_defaults, _restore_torch_defaults),
)
"""Every watched setting."""

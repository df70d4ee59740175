"""Plugins of every kind that change the process, keep files open, or fail with an error that must
not be shown.
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
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from mutation import Mutant, counted, mutate, then
from pydantic import BaseModel, ConfigDict, Field, SecretStr

from rn_testing.fakes import (
    ControlledSource,
    CountingRuntime,
    FakeDriver,
    GantryController,
    HalvingAcceleration,
    InstantBackend,
)
from roboneuron.errors import NotReadyError

BASES: dict[str, tuple[type, str, str]] = {
    "backend": (InstantBackend, "load", "predict"),
    "runtime": (CountingRuntime, "load", "run"),
    "perception": (ControlledSource, "open", "read"),
    "controller": (GantryController, "load", "compute"),
    "driver": (FakeDriver, "open", "send"),
}
"""By kind: the good plugin, its start, and its use."""
LEFT: list[int] = []
"""Descriptors left open by mutants; the tests close them."""


class Options(BaseModel):
    """Options, some of which name a file or hold a secret."""

    model_config = ConfigDict(extra="forbid")

    weights_path: str = Field(default="", description="file with weights")
    api_token: SecretStr = Field(default=SecretStr(""), description="token of the server")
    gain: float = Field(default=1.0, description="gain")


OPTIONS = {"config": "mutants_processes:Options"}


def leave_open() -> None:
    """Open a file that is never closed."""
    LEFT.append(os.open("/dev/null", os.O_RDONLY))


def leave_socket() -> None:
    """Listen on a port without closing it."""
    listener = socket.socket()
    listener.bind(("127.0.0.1", 0))
    listener.listen()
    LEFT.append(listener.detach())


def write_here() -> None:
    """Leave a file in the working folder."""
    Path(f"left-by-a-mutant-{time.monotonic_ns()}.log").write_text("log")


CHANGES: dict[str, Callable[[], object]] = {
    "ignores_sigterm": lambda: signal.signal(signal.SIGTERM, signal.SIG_IGN),
    "takes_ctrl_c": lambda: signal.signal(signal.SIGINT, lambda *_: None),
    "changes_the_folder": lambda: os.chdir("/"),
    "changes_the_environment": lambda: os.environ.update(ROBONEURON_MUTANT="1"),
    "empties_a_variable": lambda: os.environ.pop("PATH"),
    "seeds_random": lambda: random.seed(0),
    "seeds_numpy": lambda: np.random.seed(0),
    "prints": lambda: print("ready"),
    "prints_by_descriptor": lambda: os.write(1, b"ready\n"),
    "prints_by_a_process": lambda: subprocess.run(["echo", "ready"], check=True),
    "configures_logging": lambda: logging.getLogger().addHandler(logging.NullHandler()),
    "silences_logging": lambda: logging.disable(logging.CRITICAL),
    "silences_warnings": lambda: warnings.simplefilter("ignore"),
    "ignores_numpy_errors": lambda: np.seterr(all="ignore"),
    "changes_print_options": lambda: np.set_printoptions(precision=2),
    "changes_the_umask": lambda: os.umask(0),
    "changes_the_locale": lambda: locale.setlocale(
        locale.LC_ALL, "C" if "UTF" in now() else "C.UTF-8"
    ),
    "changes_the_default_timeout": lambda: socket.setdefaulttimeout(3.0),
    "changes_the_import_path": lambda: sys.path.insert(0, "/opt/models"),
    "changes_the_exception_hook": lambda: setattr(sys, "excepthook", lambda *_: None),
    "changes_the_hook_of_threads": lambda: setattr(threading, "excepthook", lambda *_: None),
    "changes_the_recursion_limit": lambda: sys.setrecursionlimit(sys.getrecursionlimit() + 1000),
    "stops_garbage_collection": gc.disable,
    "registers_an_exit_handler": lambda: atexit.register(int),
    "replaces_stdout": lambda: setattr(sys, "stdout", sys.stderr),
    "leaves_a_temporary_folder": lambda: tempfile.mkdtemp(prefix="left-by-a-mutant-"),
    "leaves_a_file_in_the_folder": write_here,
    "rewrites_a_file_in_the_folder": lambda: Path("state-of-a-mutant.json").write_text("{}"),
    "writes_into_a_folder_of_the_folder": lambda: then(
        Path("cache").mkdir(exist_ok=True), Path("cache/of-a-mutant").write_text("")
    ),
    "changes_the_folder_and_back": lambda: then(here := os.getcwd(), os.chdir("/"), os.chdir(here)),
    "changes_a_variable_and_back": lambda: then(
        os.environ.update(ROBONEURON_MUTANT="2"), os.environ.pop("ROBONEURON_MUTANT")
    ),
    "sets_the_recursion_limit": lambda: sys.setrecursionlimit(5000),
}
"""Changes of the process, by name."""
OF_EVERY_KIND = (
    "ignores_sigterm",
    "changes_the_folder",
    "changes_the_environment",
    "seeds_numpy",
    "prints",
)


def now() -> str:
    return locale.setlocale(locale.LC_ALL)


def doing(method: str, change: Callable[[], object]) -> dict[str, Callable[..., object]]:
    """A method that does `change` first."""
    return {
        method: lambda self, call, *arguments, **named: then(change(), call(*arguments, **named))
    }


def changing(kind: str, name: str, *, in_use: bool = False) -> Mutant:
    base, begin, use = BASES[kind]
    target = mutate(base, **doing(use if in_use else begin, CHANGES[name]))
    return Mutant(rule=f"{kind}/process-left-alone", target=target)


def with_options(
    self: Any, call: Callable[..., None], options: Any, *arguments: object, **named: object
) -> None:
    """A constructor that keeps its options."""
    call(None, *arguments, **named)
    self.kept = options


def reading(self: Any, call: Callable[..., object], *arguments: object) -> object:
    if self.kept is not None and self.kept.weights_path:
        Path(self.kept.weights_path).read_bytes()
    return call(*arguments)


def of_a_file(kind: str) -> Mutant:
    base, begin, _ = BASES[kind]
    target = mutate(base, __init__=with_options, **{begin: reading})
    return Mutant(
        rule=f"{kind}/missing-file-refused", words="FileNotFoundError", target=target, spec=OPTIONS
    )


def telling(text: Callable[[Any], str]) -> Callable[..., object]:
    """A method that refuses with this text if something is wrong."""

    def method(self: Any, call: Callable[..., object], *arguments: object) -> object:
        try:
            return call(*arguments)
        except Exception as error:
            raise type(error)(text(self)) from None

    return method


def told(kind: str, text: Callable[[Any], str], words: str, method: str = "") -> Mutant:
    base, _, use = BASES[kind]
    target = mutate(base, __init__=with_options, **{method or use: telling(text)})
    return Mutant(rule=f"{kind}/errors-readable", words=words, target=target, spec=OPTIONS)


def token_of(self: Any) -> str:
    return (
        "The server refuses the token "
        f"{'' if self.kept is None else self.kept.api_token.get_secret_value()}."
    )


def options_of(self: Any) -> str:
    return (
        f"The options are {self.kept and self.kept.api_token.get_secret_value()}, and that "
        "does not work."
    )


def environment_of(self: Any) -> str:
    return f"It failed in the environment {dict(os.environ)}"[:100_000]


def refuses_with_token(self: Any, call: Callable[..., object], *arguments: object) -> object:
    secret = self.kept.api_token.get_secret_value()
    if secret:
        raise NotReadyError(f"http://{secret}@server/ does not answer.")
    return call(*arguments)


def while_handling(self: Any, call: Callable[..., object], *arguments: object) -> object:
    """The secret is in the cause of this error, and so in every traceback."""
    try:
        return call(*arguments)
    except Exception as error:
        cause = ValueError(f"token {self.kept and self.kept.api_token.get_secret_value()}")
        raise type(error)("It does not work.") from cause


def second_refuses(self: Any, call: Callable[..., object], *arguments: object) -> object:
    if counted(self) > 1:
        raise NotReadyError("The device is busy.")
    return call(*arguments)


def of_a_handle(kind: str, rule: str, method: str, act: Callable[[], None] = leave_open) -> Mutant:
    return Mutant(
        rule=f"{kind}/{rule}", words="open", target=mutate(BASES[kind][0], **doing(method, act))
    )


def written_to(self: Any, call: Callable[..., object], *arguments: object) -> object:
    self.kept.gain *= 2
    return call(*arguments)


def slowly(self: Any, call: Callable[..., object], *arguments: object, **named: object) -> None:
    time.sleep(0.4)
    call(*arguments, **named)


def constructing(name: str) -> Mutant:
    """A backend whose constructor makes the change, so that it stands when the rule begins."""
    target = mutate(InstantBackend, **doing("__init__", CHANGES[name]))
    return Mutant(rule="backend/process-left-alone", target=target)


IN_CONSTRUCTOR = (
    "changes_the_folder",
    "changes_the_environment",
    "stops_garbage_collection",
    "changes_the_umask",
    "changes_the_default_timeout",
    "sets_the_recursion_limit",
    "rewrites_a_file_in_the_folder",
)

MUTANTS: dict[str, Mutant] = {
    **{f"backend_{name}": changing("backend", name) for name in CHANGES},
    **{f"backend_{name}_in_use": changing("backend", name, in_use=True) for name in IN_CONSTRUCTOR},
    **{f"backend_constructor_{name}": constructing(name) for name in IN_CONSTRUCTOR},
    **{
        f"{kind}_{name}": changing(kind, name)
        for kind in BASES
        if kind != "backend"
        for name in OF_EVERY_KIND
    },
    **{
        f"{kind}_{name}_in_use": changing(kind, name, in_use=True)
        for kind in BASES
        for name in ("prints", "seeds_random")
    },
    "acceleration_seeds_numpy": Mutant(
        rule="acceleration/process-left-alone",
        target=mutate(HalvingAcceleration, **doing("apply", CHANGES["seeds_numpy"])),
    ),
    "acceleration_prints": Mutant(
        rule="acceleration/process-left-alone",
        target=mutate(HalvingAcceleration, **doing("apply", CHANGES["prints"])),
    ),
    **{f"{kind}_file_not_found": of_a_file(kind) for kind in BASES},
    **{f"{kind}_tells_its_token": told(kind, token_of, "secret") for kind in BASES},
    "backend_tells_its_options": told("backend", options_of, "secret"),
    "backend_tells_the_environment": told("backend", environment_of, ""),
    "backend_tells_a_traceback": told(
        "backend", lambda s: "Traceback (most recent call last): ...", "traceback"
    ),
    "backend_tells_everything": told("backend", lambda s: "no, " * 5000, "characters"),
    "backend_says_nothing": told("backend", lambda s: "", "says nothing"),
    "backend_token_in_the_address": Mutant(
        rule="backend/errors-readable",
        words="secret",
        target=mutate(InstantBackend, __init__=with_options, load=refuses_with_token),
        spec=OPTIONS,
    ),
    "backend_token_in_the_cause": Mutant(
        rule="backend/errors-readable",
        words="secret",
        target=mutate(InstantBackend, __init__=with_options, predict=while_handling),
        spec=OPTIONS,
    ),
    **{
        f"{kind}_second_{begin}_is_busy": Mutant(
            rule=f"{kind}/second-{begin}-safe",
            words="busy",
            target=mutate(base, **{begin: second_refuses}),
        )
        for kind, (base, begin, _) in BASES.items()
    },
    **{
        f"{kind}_leaves_a_file_open": of_a_handle(kind, "close-releases", begin)
        for kind, (_, begin, _) in BASES.items()
    },
    "backend_leaves_a_port_open": of_a_handle("backend", "close-releases", "load", leave_socket),
    **{
        f"{kind}_opens_a_file_with_every_{use}": of_a_handle(kind, "memory-bounded", use)
        for kind, (_, _, use) in BASES.items()
        if kind != "driver"
    },
    "driver_opens_a_file_with_every_read": of_a_handle("driver", "memory-bounded", "read"),
    "driver_opens_a_file_with_every_send": of_a_handle("driver", "close-releases", "send"),
    **{
        f"{kind}_constructor_sleeps": Mutant(
            rule=f"{kind}/constructor-pure", words="takes", target=mutate(base, __init__=slowly)
        )
        for kind, (base, _, _) in BASES.items()
    },
    **{
        f"{kind}_writes_to_its_options": Mutant(
            rule=f"{kind}/options-read",
            words="are changed",
            target=mutate(base, __init__=with_options, **{use: written_to}),
            spec=OPTIONS,
        )
        for kind, (base, _, use) in BASES.items()
    },
}


def __getattr__(name: str) -> object:
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target

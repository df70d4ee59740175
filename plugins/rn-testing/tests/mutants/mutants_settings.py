"""Backends that change a setting of the process, written down before a rule was looked for."""

from __future__ import annotations

import asyncio
import json
import logging
import multiprocessing
import os
import resource
import signal
import ssl
import sys
import threading
import time
import urllib.request
import warnings
from collections.abc import Callable

import numpy as np
from mutants_processes import doing
from mutation import Mutant, mutate

from rn_testing.fakes import InstantBackend

CHANGES: dict[str, Callable[[], object]] = {
    "changes_the_switch_interval": lambda: sys.setswitchinterval(0.5),
    "pins_the_processor": lambda: os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}),
    "limits_open_files": lambda: resource.setrlimit(
        resource.RLIMIT_NOFILE, (900, resource.getrlimit(resource.RLIMIT_NOFILE)[1])
    ),
    "captures_warnings": lambda: logging.captureWarnings(True),
    "replaces_how_warnings_are_shown": lambda: setattr(
        warnings, "showwarning", lambda *_, **__: None
    ),
    "trusts_every_certificate": lambda: setattr(
        ssl, "_create_default_https_context", ssl._create_unverified_context
    ),
    "replaces_a_function_of_json": lambda: setattr(json, "dumps", lambda *a, **k: "{}"),
    "replaces_a_function_of_numpy": lambda: setattr(np, "clip", lambda a, *_, **__: a),
    "replaces_the_clock": lambda: setattr(time, "time", lambda: 0.0),
    "sets_an_alarm": lambda: signal.setitimer(signal.ITIMER_REAL, 3000),
    "silences_the_core": lambda: logging.getLogger("roboneuron").setLevel(logging.CRITICAL),
    "replaces_the_event_loop": lambda: asyncio.set_event_loop_policy(
        asyncio.DefaultEventLoopPolicy()
    ),
    "chooses_how_processes_start": lambda: multiprocessing.set_start_method("spawn", force=True),
    "installs_an_opener": lambda: urllib.request.install_opener(urllib.request.build_opener()),
    "traces_its_threads": lambda: threading.settrace(lambda *_: None),
    "sets_the_stack_of_threads": lambda: threading.stack_size(262_144),
}
"""Changes of the process that last."""

MUTANTS: dict[str, Mutant] = {
    f"backend_{name}": Mutant(
        rule="backend/process-left-alone", target=mutate(InstantBackend, **doing("load", change))
    )
    for name, change in CHANGES.items()
}


def __getattr__(name: str) -> object:
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target

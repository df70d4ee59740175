"""State of the whole process, which no plugin may change: its settings, random generators, output.

A difference after a plugin was built, started, used and closed is tested a second time, because
what libraries do once per process, at import, does not recur.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from rn_testing.effects import Marks, watch_marks
from rn_testing.process_settings import LIBRARY_VARIABLES, SETTINGS, loaded_torch

_SEEDS = (20_011, 40_013)
"""Seeds of the global generators in the two trials: a plugin that only draws ends in different
states.
"""


def _generators() -> dict[str, Callable[[], bytes]]:
    """State of each global random generator."""
    found = {
        "random": lambda: repr(random.getstate()).encode(),
        "numpy.random": lambda: (
            repr(np.random.get_state(legacy=False)).encode() + np.random.get_state()[1].tobytes()  # type: ignore[index]
        ),
    }
    torch = loaded_torch()
    if torch is not None:
        found["torch"] = lambda: str(torch.initial_seed()).encode()  # drawing does not change it
    return found


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Seed the global generators, and restore them at the end."""
    torch = loaded_torch()
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
def _watched_signals(asked: list[str]) -> Iterator[None]:
    """Append to `asked` a sentence part for each signal for which a handler or a timer is set; in
    the rules' thread Python would refuse the handler.
    """

    def handle(number: int, handler: object) -> object:
        asked.append(f"sets a handler for {signal.Signals(number).name}")
        return signal.getsignal(number)

    def alarm(seconds: int) -> int:
        asked.append("sets a timer that sends a signal")
        return 0

    def set_timer(which: int, seconds: float, interval: float = 0.0) -> tuple[float, float]:
        return float(alarm(0)), 0.0

    watched = {"signal": handle, "alarm": alarm, "setitimer": set_timer}
    real = {name: getattr(signal, name) for name in watched}
    for name, note in watched.items():
        setattr(signal, name, note)
    try:
        yield
    finally:
        for name, function in real.items():
            setattr(signal, name, function)


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
    before = [setting.read() for setting in SETTINGS]
    changes: list[str] = []
    try:
        for setting in SETTINGS:
            if setting.unusual:
                setting.restore(setting.unusual[trial])
        with _seeded(_SEEDS[trial]):
            begun = {name: read() for name, read in _generators().items()}
            with watch_marks() as marks, _watched_signals(asked), _watched_output(printed):
                within = [setting.read() for setting in SETTINGS]
                action()
                after = [setting.read() for setting in SETTINGS]
            ended = {name: read() for name, read in _generators().items() if name in begun}
    finally:
        for setting, old in zip(SETTINGS, before, strict=True):
            if setting.read() != old:
                setting.restore(old)
    changes += [
        f"changes {setting.name}{_difference(then, now)}"
        for setting, then, now in zip(SETTINGS, within, after, strict=True)
        if now != then
    ]
    changes += _marked(marks, {change.partition(" (")[0] for change in changes})
    changes += dict.fromkeys(asked)
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

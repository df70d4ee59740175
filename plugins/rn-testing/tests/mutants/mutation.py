"""Mutants: a good plugin from the kit's fakes with one mistake, and the rule that must detect
it.
"""

from __future__ import annotations

import itertools
import random
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from roboneuron.errors import RoboNeuronError


@dataclass(frozen=True, kw_only=True)
class Mutant:
    """One mistake.

    Attributes:
        rule: id of the rule that detects it.
        target: the class or function instead of the good one; None for the good one.
        spec, case: changed fields of descriptor and case.
        words: expected part of the rule's message; empty for any.
    """

    rule: str
    target: Any = None
    spec: dict[str, object] = field(default_factory=dict)
    case: dict[str, object] = field(default_factory=dict)
    words: str = ""


def mutate(base: type, **changes: Callable[..., object]) -> type:
    """A subclass of `base` with changed methods.

    Each change is called as `change(self, call, *arguments)`; `call` is the good method.
    """
    made = type(f"Mutated{base.__name__}", (base,), {})

    def method(name: str, change: Callable[..., object]) -> Callable[..., object]:
        def changed(self: Any, *arguments: object, **named: object) -> object:
            return change(self, getattr(super(made, self), name, None), *arguments, **named)

        return changed

    for name, change in changes.items():
        setattr(made, name, method(name, change))
    return made


def mutants_of(subject: str, good: type) -> Callable[..., Mutant]:
    """Return a function that makes mutants of `good` from the rule that must detect them, without
    its `subject`, and the changed methods.
    """

    def make(
        rule: str,
        words: str = "",
        *,
        spec: dict[str, object] | None = None,
        case: dict[str, object] | None = None,
        **changes: Callable[..., object],
    ) -> Mutant:
        return Mutant(
            rule=f"{subject}/{rule}",
            target=mutate(good, **changes) if changes else None,
            spec=spec or {},
            case=case or {},
            words=words,
        )

    return make


_draws = itertools.count()


def noise(scale: float) -> float:
    """A random number; successive ones differ by at least `scale`, because by chance two could be
    too close.
    """
    return scale * (2 * (next(_draws) % 11) + random.random())


def counted(self: Any) -> int:
    """1, 2, 3 ... with every call on one object."""
    self.counted = getattr(self, "counted", 0) + 1
    return self.counted


def then(*steps: object) -> object:
    """Return the last of a lambda's steps."""
    return steps[-1]


def remembered(self: Any, value: object) -> object:
    """Return `value` after storing it with 8 kB forever in `self`: on a busy machine there are few
    calls, and less than 2 kB is noise.
    """
    self.memory = [*getattr(self, "memory", []), (value, bytes(8192))]
    return value


def leave_thread() -> None:
    """Start a thread that outlives the rule."""
    threading.Thread(target=time.sleep, args=(7,), name="forgotten", daemon=True).start()


def compute() -> None:
    """Use processor time."""
    until_s = time.thread_time() + 0.6
    while time.thread_time() < until_s:
        pass


def read_file() -> None:
    """Open a file."""
    open("/proc/self/status", "rb").close()


def or_else(call: Callable[[], object], default: Callable[[], object]) -> object:
    """Return the result of `call`, or of `default` if it refuses."""
    try:
        return call()
    except RoboNeuronError:
        return default()


def forever(*_: object, **__: object) -> None:
    """Hang longer than any bound of the tests."""
    time.sleep(30)

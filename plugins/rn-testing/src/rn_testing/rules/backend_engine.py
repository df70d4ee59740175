"""Rules of backends about runtime and acceleration: both are used, and an error of the runtime
reaches the caller.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

from rn_testing.cases import BackendCase
from rn_testing.rule import NotApplicable, Rule, Violation, require
from rn_testing.rules.backend import backend_rule, loaded, predict
from roboneuron import (
    Acceleration,
    AnyAcceleration,
    AnyRuntime,
    NotReadyError,
    RoboNeuronError,
    Runtime,
    UnsafeError,
)

_ERRORS = (NotReadyError("The server does not answer."), UnsafeError("The answer is NaN."))
"""Errors to which a module reacts in different ways."""


class _Watched:
    """A runtime or an acceleration that notes what is done with it, and may refuse to run.

    Attributes:
        inner: the real one.
        fails: raised by `run`; None to run.
        is_used: `load` got an acceleration, or `apply` was called.
    """

    def __init__(self, inner: Any) -> None:
        self.inner = inner
        self.fails: Exception | None = None
        self.is_used = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def load(self, model: object, acceleration: Acceleration[Any] | None = None) -> None:
        """As the real one."""
        self.is_used = self.is_used or acceleration is not None
        self.inner.load(model, acceleration)

    def run(self, request: object) -> object:
        """As the real one, unless it fails."""
        if self.fails is not None:
            raise self.fails
        return self.inner.run(request)

    def abort(self) -> None:
        """As the real one."""
        self.inner.abort()

    def close(self) -> None:
        """As the real one."""
        self.inner.close()

    def apply(self, decoder: object) -> None:
        """As the real one."""
        self.is_used = True
        self.inner.apply(decoder)


def _watched(make: Callable[[], Any] | None, made: list[_Watched]) -> Callable[[], Any] | None:
    if make is None:
        return None

    def build() -> _Watched:
        made.append(_Watched(make()))
        return made[-1]

    return build


def _check_errors(case: BackendCase) -> None:
    runtimes: list[_Watched] = []
    make = cast("Callable[[], AnyRuntime] | None", _watched(case.runtime, runtimes))
    if make is None:
        raise NotApplicable("the case gives no runtime")
    with loaded(replace(case, runtime=make)) as backend:
        predict(case, backend)
        for error in _ERRORS:
            runtimes[-1].fails = error
            kind = type(error)
            try:
                predict(case, backend)
            except kind:
                continue
            except RoboNeuronError as other:
                told = f"a {kind.__name__} of the runtime became {type(other).__name__}: {other}"
                raise Violation(told) from other
            raise Violation(f"predict acts although its runtime raised {kind.__name__}")
        runtimes[-1].fails = None
        predict(case, backend)


def _check_acceleration(case: BackendCase) -> None:
    runtimes: list[_Watched] = []
    presets: list[_Watched] = []
    make = _watched(case.acceleration, presets)
    if make is None:
        raise NotApplicable("the case gives no acceleration")
    changed = replace(
        case,
        acceleration=cast("Callable[[], AnyAcceleration]", make),
        runtime=cast("Callable[[], AnyRuntime] | None", _watched(case.runtime, runtimes)),
    )
    with loaded(changed) as backend:
        predict(case, backend)
    is_used = any(one.is_used for one in (*runtimes, *presets))
    require(is_used, "it neither applies its acceleration nor passes it on to its runtime")


RULES: tuple[Rule[BackendCase], ...] = (
    backend_rule(
        "runtime-errors-kept",
        "An error of its runtime reaches the caller with its type, and `predict` works afterwards.",
        f"{Runtime.__module__}.Runtime.run",
        _check_errors,
    ),
    backend_rule(
        "acceleration-passed-on",
        "Its acceleration is applied, or given to its runtime.",
        f"{Runtime.__module__}.Runtime.load",
        _check_acceleration,
    ),
)
"""Rules of backends about runtime and acceleration."""

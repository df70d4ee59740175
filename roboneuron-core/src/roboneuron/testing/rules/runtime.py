"""Rules of runtimes: they execute the families they declare, and can be given up and closed at any time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from roboneuron.contract import Runtime
from roboneuron.errors import StateError
from roboneuron.testing.cases import RuntimeCase
from roboneuron.testing.effects import expect_refusal, within
from roboneuron.testing.lifecycle import (
    attempt,
    check_close_before_start,
    check_close_twice_and_release,
    check_protocol,
    check_pure_constructor,
    started,
)
from roboneuron.testing.rule import NotApplicable, Rule, require

T = TypeVar("T")

ABORT_LIMIT_S = 2.0
"""`abort` gives up; it does not wait for what it gives up."""


def _given(make: Callable[[], T] | None, what: str) -> Callable[[], T]:
    if make is None:
        raise NotApplicable(f"the case gives no {what}")
    return make


@contextmanager
def _loaded(case: RuntimeCase) -> Iterator[Runtime]:
    model = _given(case.model, "model")
    with started(case, case.build, lambda runtime: runtime.load(model())) as runtime:
        yield runtime


def _check_protocol(case: RuntimeCase) -> None:
    check_protocol(attempt(case, case.build), Runtime)


def _check_families(case: RuntimeCase) -> None:
    require(bool(case.spec.families), "the descriptor declares no model family")


def _check_pure(case: RuntimeCase) -> None:
    check_pure_constructor(case, case.build)


def _check_close_first(case: RuntimeCase) -> None:
    check_close_before_start(case, case.build)


def _check_run(case: RuntimeCase) -> None:
    request = _given(case.request, "request")
    with _loaded(case) as runtime:
        require(runtime.run(request()) is not None, "run returned None, expected the answer")
        require(runtime.run(request()) is not None, "the second run returned None, expected the answer")


def _check_run_first(case: RuntimeCase) -> None:
    request = _given(case.request, "request")
    runtime = attempt(case, case.build)
    try:
        expect_refusal(lambda: runtime.run(request()), "run before load", StateError)
    finally:
        runtime.close()


def _check_run_last(case: RuntimeCase) -> None:
    request = _given(case.request, "request")
    with _loaded(case) as runtime:
        pass
    expect_refusal(lambda: runtime.run(request()), "run after close", StateError)


def _check_bad_request(case: RuntimeCase) -> None:
    bad_request = _given(case.bad_request, "bad request")
    with _loaded(case) as runtime:
        expect_refusal(lambda: runtime.run(bad_request()), "run of a bad request")


def _check_acceleration(case: RuntimeCase) -> None:
    make = _given(case.acceleration, "acceleration")
    model = _given(case.model, "model")
    request = _given(case.request, "request")
    with started(case, case.build, lambda runtime: runtime.load(model(), make())) as runtime:
        require(runtime.run(request()) is not None, "run returned None with an acceleration, expected the answer")


def _check_abort(case: RuntimeCase) -> None:
    runtime = attempt(case, case.build)
    try:
        within(ABORT_LIMIT_S, runtime.abort, "abort before load")
    finally:
        runtime.close()
    if case.model is not None and case.request is not None:
        with _loaded(case) as loaded:
            within(ABORT_LIMIT_S, loaded.abort, "abort without a run")
            require(loaded.run(case.request()) is not None, "run after a harmless abort returned None")


def _check_release(case: RuntimeCase) -> None:
    model = _given(case.model, "model")
    check_close_twice_and_release(case, case.build, lambda runtime: runtime.load(model()))


_SOURCE = "roboneuron.contract.protocols.Runtime"

RULES: tuple[Rule[RuntimeCase], ...] = (
    Rule(id="runtime/protocol", text="It has the methods of Runtime.", source=_SOURCE, check=_check_protocol),
    Rule(
        id="runtime/families-declared",
        text="The descriptor names at least one model family.",
        source="roboneuron.plugins.specs.RuntimeSpec",
        check=_check_families,
    ),
    Rule(
        id="runtime/constructor-pure",
        text="The constructor opens no file, starts no thread or process and computes nothing that takes time.",
        source="roboneuron.contract.protocols",
        check=_check_pure,
    ),
    Rule(
        id="runtime/close-before-load",
        text="`close` may be called twice and before `load`.",
        source=f"{_SOURCE}.close",
        check=_check_close_first,
    ),
    Rule(
        id="runtime/run-answers",
        text="After `load`, `run` answers one request after the other.",
        source=f"{_SOURCE}.run",
        check=_check_run,
    ),
    Rule(
        id="runtime/run-before-load-refused",
        text="`run` before `load` is a StateError.",
        source=f"{_SOURCE}.run",
        check=_check_run_first,
    ),
    Rule(
        id="runtime/run-after-close-refused",
        text="`run` after `close` is a StateError.",
        source=f"{_SOURCE}.run",
        check=_check_run_last,
    ),
    Rule(
        id="runtime/bad-request-refused",
        text="A request that its family does not allow is refused.",
        source=f"{_SOURCE}.run",
        check=_check_bad_request,
    ),
    Rule(
        id="runtime/acceleration-accepted",
        text="`load` takes an acceleration whose capability the descriptor offers, and `run` answers with it.",
        source=f"{_SOURCE}.load",
        check=_check_acceleration,
    ),
    Rule(
        id="runtime/abort-harmless",
        text="`abort` returns at once when nothing runs, before and after `load`.",
        source=f"{_SOURCE}.abort",
        check=_check_abort,
    ),
    Rule(
        id="runtime/close-releases",
        text="After `load`, `close` may be called twice and leaves no thread or process behind.",
        source=f"{_SOURCE}.close",
        check=_check_release,
    ),
)
"""Rules of runtimes."""

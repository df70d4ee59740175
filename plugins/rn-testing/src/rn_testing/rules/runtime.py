"""Rules of runtimes: repeatable answers for their declared families, abort and close."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

from rn_testing.attempts import attempt
from rn_testing.cases import RuntimeCase
from rn_testing.effects import check_quick, expect_refusal, within
from rn_testing.lifecycle import Lifecycle, started
from rn_testing.rule import NotApplicable, Rule, require
from rn_testing.rules.clock import later
from rn_testing.snapshots import has_nan, is_alike, snapshot
from roboneuron import Acceleration, InvalidInputError, RoboNeuronError, Runtime

T = TypeVar("T")
Tried = Runtime[Any, Any, Any, Any]
"""Of any family: requests and answers are defined per family."""

ABORT_LIMIT_S = 2.0
"""`abort` must return without waiting for the run."""
BEGIN_S = 0.2
"""Time for a run to begin before it is aborted [s]."""


def _given(make: Callable[[], T] | None, what: str) -> Callable[[], T]:
    if make is None:
        raise NotApplicable(f"the case gives no {what}")
    return make


def _load(case: RuntimeCase, runtime: Tried) -> None:
    runtime.load(_given(case.model, "model")())


def _run(case: RuntimeCase, runtime: Tried) -> object:
    return _answer(runtime, _given(case.request, "request")())


def _answer(runtime: Tried, request: object) -> object:
    answer = runtime.run(request)
    require(answer is not None, "run returned None, expected the answer")
    require(not has_nan(answer), "the answer holds a number that is NaN")
    return answer


LIFECYCLE: Lifecycle[RuntimeCase, Tried] = Lifecycle(
    subject="runtime",
    protocol=Runtime,
    begin="load",
    start=_load,
    uses={"run": _run},
    abuses=(
        lambda case, runtime: runtime.run(object()),
        lambda case, runtime: runtime.load(object()),
    ),
    besides=("abort",),
    repeat=10,
)
"""Start and use of a runtime."""
_loaded = LIFECYCLE.running


def _check_families(case: RuntimeCase) -> None:
    require(bool(case.spec.families), "the descriptor declares no model family")


def _check_run(case: RuntimeCase) -> None:
    with _loaded(case) as runtime:
        _run(case, runtime)
        _run(case, runtime)


def _check_expected(case: RuntimeCase) -> None:
    expected = _given(case.expected, "expected answer")()
    with _loaded(case) as runtime:
        answer = _run(case, runtime)
    require(is_alike(answer, expected), f"run answered {answer!r}, the case expects {expected!r}")


def _check_reply(case: RuntimeCase) -> None:
    check = case.check_answer
    if check is None:
        raise NotApplicable("the case does not say what an answer holds")
    request, model = _given(case.request, "request")(), _given(case.model, "model")()
    with _loaded(case) as runtime:
        check(model, request, _answer(runtime, request))


def _check_repeats(case: RuntimeCase) -> None:
    request = _given(case.request, "request")
    others = [make for make in (case.other_request, case.bad_request) if make is not None]
    with _loaded(case) as runtime:
        first = copy.deepcopy(_run(case, runtime))
        for make in [request, *others]:
            with suppress(RoboNeuronError):  # the bad request must not have an effect either
                runtime.run(make())
            again = _run(case, runtime)
            require(is_alike(first, again), "the answer to a request changes after another request")
        with later():
            require(is_alike(first, _run(case, runtime)), "an hour later the answer is another one")


def _check_fresh(case: RuntimeCase) -> None:
    answers = []
    for _ in range(2):
        with _loaded(case) as runtime:
            answers.append(copy.deepcopy(_run(case, runtime)))
    require(is_alike(*answers), "a second runtime answers the same request differently")


def _check_answer_kept(case: RuntimeCase) -> None:
    other = case.other_request or _given(case.request, "request")
    with _loaded(case) as runtime:
        first = _run(case, runtime)
        before = snapshot(first)
        _answer(runtime, other())
    require(snapshot(first) == before, "an answer changes when the next request is run")


def _check_input_kept(case: RuntimeCase) -> None:
    request = _given(case.request, "request")()
    before = snapshot(request)
    with _loaded(case) as runtime:
        _answer(runtime, request)
    require(snapshot(request) == before, "run changed its request")


def _check_quick(case: RuntimeCase) -> None:
    with _loaded(case) as runtime:
        check_quick(case.run_limit_s, lambda: _run(case, runtime), "run")


def _check_bad_request(case: RuntimeCase) -> None:
    bad_request = _given(case.bad_request, "bad request")
    with _loaded(case) as runtime:
        expect_refusal(lambda: runtime.run(bad_request()), "run of a bad request")
        expect_refusal(lambda: runtime.run(object()), "run of an object that is not a request")


def _check_bad_model(case: RuntimeCase) -> None:
    _given(case.model, "model")
    runtime = LIFECYCLE.built(case)
    try:
        expect_refusal(lambda: runtime.load(object()), "load of an object that is not a model")
    finally:
        runtime.close()


class _CountedAcceleration:
    """An acceleration that counts its applications, or refuses."""

    def __init__(self, inner: Acceleration[Any], *, refuses: bool = False) -> None:
        self.inner, self.refuses, self.count = inner, refuses, 0

    def __getattr__(self, name: str) -> object:
        return getattr(self.inner, name)

    def apply(self, decoder: object) -> None:
        self.count += 1
        if self.refuses:
            raise InvalidInputError("The decoder is of a kind that the preset does not know.")
        self.inner.apply(decoder)


def _check_acceleration(case: RuntimeCase) -> None:
    make, model = _given(case.acceleration, "acceleration"), _given(case.model, "model")
    _given(case.request, "request")
    preset = _CountedAcceleration(make())
    with started(case, case.build, lambda runtime: runtime.load(model(), preset)) as runtime:
        _run(case, runtime)
    require(
        preset.count > 0 or case.spec.served,
        "load never applied the acceleration that it was given",
    )
    if case.spec.served:
        return
    refusing = LIFECYCLE.built(case)
    try:
        refused = _CountedAcceleration(make(), refuses=True)
        expect_refusal(
            lambda: refusing.load(model(), refused),
            "load with an acceleration that refuses the decoder",
            InvalidInputError,
        )
    finally:
        refusing.close()


def _check_acceleration_stays(case: RuntimeCase) -> None:
    make, model = _given(case.acceleration, "acceleration"), _given(case.model, "model")
    with _loaded(case) as runtime:
        plain = copy.deepcopy(_run(case, runtime))
    with started(case, case.build, lambda runtime: runtime.load(model(), make())) as runtime:
        _run(case, runtime)
        runtime.close()
        with suppress(RoboNeuronError):  # it may refuse to be loaded again
            runtime.load(model())
            require(
                is_alike(plain, _run(case, runtime)),
                "a runtime keeps its acceleration when it is loaded again without one",
            )
    with _loaded(case) as runtime:
        again = _run(case, runtime)
    require(
        is_alike(plain, again),
        "a runtime without acceleration answers differently after another runtime used one",
    )


def _check_abort(case: RuntimeCase) -> None:
    runtime = attempt(case, case.build)
    try:
        within(ABORT_LIMIT_S, runtime.abort, "abort before load")
    finally:
        runtime.close()
    if case.model is not None and case.request is not None:
        with _loaded(case) as loaded:
            first = copy.deepcopy(_run(case, loaded))
            if case.other_request is not None:
                _answer(loaded, case.other_request())
            within(ABORT_LIMIT_S, loaded.abort, "abort without a run")
            require(
                is_alike(first, _run(case, loaded)), "after abort() a request is answered otherwise"
            )


def _check_abort_works(case: RuntimeCase) -> None:
    request = _given(case.long_request or case.request, "request")()

    def run() -> None:
        try:
            runtime.run(request)
        except RoboNeuronError:  # aborted
            return

    with _loaded(case) as runtime:
        thread = threading.Thread(target=run, name="aborted-run", daemon=True)
        thread.start()
        thread.join(BEGIN_S)
        within(ABORT_LIMIT_S, runtime.abort, "abort during a run")
        thread.join(ABORT_LIMIT_S)
        require(not thread.is_alive(), f"a run goes on {ABORT_LIMIT_S:g} s after abort()")
        _run(case, runtime)


def _check_deadline(case: RuntimeCase) -> None:
    late = _given(case.late_request, "request whose deadline is over")
    with _loaded(case) as runtime:
        expect_refusal(lambda: runtime.run(late()), "run of a request whose deadline is over")
        _run(case, runtime)


_SOURCE = "roboneuron.contract.protocols.Runtime"


def _rule(
    name: str, text: str, method: str, check: Callable[[RuntimeCase], None]
) -> Rule[RuntimeCase]:
    return Rule(id=f"runtime/{name}", text=text, source=f"{_SOURCE}.{method}", check=check)


RULES: tuple[Rule[RuntimeCase], ...] = (
    *LIFECYCLE.rules(),
    Rule(
        id="runtime/families-declared",
        text="The descriptor names at least one model family.",
        source="roboneuron.plugins.specs.RuntimeSpec",
        check=_check_families,
    ),
    _rule(
        "run-answers",
        "After `load`, `run` answers one request after the other, and never with NaN.",
        "run",
        _check_run,
    ),
    _rule("run-expected", "`run` answers what the case expects.", "run", _check_expected),
    _rule(
        "reply-complete",
        "An answer holds what its request asks for, in the form of its model family.",
        "run",
        _check_reply,
    ),
    _rule(
        "run-repeatable",
        "The same request gets the same answer, whatever was run before and whatever the time.",
        "run",
        _check_repeats,
    ),
    _rule(
        "instances-agree", "Two runtimes give the same answer to a request.", "run", _check_fresh
    ),
    _rule(
        "answer-kept",
        "A returned answer is not changed later.",
        "run",
        _check_answer_kept,
    ),
    _rule("input-kept", "`run` does not change its request.", "run", _check_input_kept),
    _rule("run-quick", "`run` answers within the case's `run_limit_s`.", "run", _check_quick),
    _rule(
        "bad-request-refused",
        "A request that its family does not allow is refused.",
        "run",
        _check_bad_request,
    ),
    _rule(
        "bad-model-refused",
        "`load` refuses everything but models of its families.",
        "load",
        _check_bad_model,
    ),
    _rule(
        "acceleration-accepted",
        "`load` applies the acceleration it is given, or passes on its refusal; `run` then "
        "uses it.",
        "load",
        _check_acceleration,
    ),
    _rule(
        "acceleration-contained",
        "An acceleration changes the runtime that it was given to and no other.",
        "load",
        _check_acceleration_stays,
    ),
    _rule(
        "abort-harmless",
        "`abort` returns at once when nothing runs, before and after `load`, and changes no later "
        "answer.",
        "abort",
        _check_abort,
    ),
    _rule(
        "abort-ends-run",
        "`abort` ends a run in progress, and the next one works.",
        "abort",
        _check_abort_works,
    ),
    _rule("deadline-kept", "A request whose deadline is over is refused.", "run", _check_deadline),
)
"""Rules of runtimes."""

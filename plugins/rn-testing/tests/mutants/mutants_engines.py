"""Runtimes and accelerations with one mistake each."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from mutation import (
    Mutant,
    compute,
    counted,
    forever,
    leave_thread,
    mutants_of,
    mutate,
    noise,
    or_else,
    read_file,
    remembered,
    then,
)

from rn_testing.fakes import CountingRuntime, FakeDecoder, HalvingAcceleration
from rn_testing.rule import require
from roboneuron.errors import InvalidInputError, StateError


@dataclass(frozen=True)
class TokenRequest:
    """A request of a model family with deadlines."""

    ids: np.ndarray
    count: int
    deadline_s: float | None = None


class TokenRuntime:
    """A good runtime for token requests: token i is the sum of the ids plus i."""

    def __init__(self, config):
        self._loaded = False

    def load(self, model, acceleration=None):
        if model != "tokens":
            raise InvalidInputError("no such model")
        self._loaded = True

    def run(self, request):
        if not self._loaded:
            raise StateError("not loaded")
        if not isinstance(request, TokenRequest) or request.count > 8:
            raise InvalidInputError("no TokenRequest")
        if request.deadline_s is not None and request.deadline_s < time.monotonic():
            raise StateError("too late")
        return int(request.ids.sum()) + np.arange(request.count)

    def abort(self): ...

    def close(self):
        self._loaded = False


def token_request(count=4, deadline_s=None):
    return TokenRequest(ids=np.array([1, 2, count]), count=count, deadline_s=deadline_s)


def check_tokens(model, request, answer):
    require(len(answer) == request.count, f"{len(answer)} tokens, asked for {request.count}")


TOKENS = {
    "model": lambda: "tokens",
    "request": token_request,
    "bad_request": lambda: token_request(9),
    "other_request": lambda: token_request(5),
    "late_request": lambda: token_request(deadline_s=time.monotonic() - 1.0),
    "check_answer": check_tokens,
    "acceleration": None,
    "expected": None,
}
"""Case of the runtime for token requests."""
but = mutants_of("runtime", CountingRuntime)


def tokens(rule, words="", *, case=None, **changes):
    case = {**TOKENS, **(case or {})}
    return Mutant(
        rule=f"runtime/{rule}", target=mutate(TokenRuntime, **changes), case=case, words=words
    )


def leaking(self, call, request):
    answer = call(request) + getattr(self, "left", 0)
    self.left = (
        len(request.split())
        if isinstance(request, str) and len(request.split()) != 4
        else getattr(self, "left", 0)
    )
    return answer


def left_by_refusal(self, call, request):
    if not isinstance(request, str):
        self.refused = True
    return call(request) + getattr(self, "refused", False)


def shared_list(self, call, request):
    self.answer = getattr(self, "answer", [0])
    self.answer[0] = call(request)
    return self.answer


def painted(self, call, request):
    good = call(request)
    request.ids[:] = 0
    return good


class Preset(CountingRuntime):
    factor = 1.0


def global_preset(self, call, model, acceleration=None):
    call(model, acceleration)
    if acceleration is not None:
        type(self).factor = 0.25


def quiet_acceleration(self, call, model, acceleration=None):
    or_else(lambda: call(model, acceleration), lambda: call(model))


def never_again(self, call):
    self.aborted = True


RUNTIMES: dict[str, Mutant] = {
    "no_abort": Mutant(
        rule="runtime/protocol",
        target=mutate(
            object, **dict.fromkeys(("__init__", "load", "run", "close"), lambda *_: None)
        ),
    ),
    "constructor_reads_a_file": but(
        "constructor-pure", __init__=lambda s, call, c: then(call(c), read_file())
    ),
    "constructor_starts_a_thread": but(
        "constructor-pure", __init__=lambda s, call, c: then(call(c), leave_thread())
    ),
    "constructor_computes": but(
        "constructor-pure", __init__=lambda s, call, c: then(call(c), compute())
    ),
    "constructor_hangs": but(
        "protocol",
        "the constructor did not return",
        case={"limits_s": {"constructor": 0.3}},
        __init__=forever,
    ),
    "options_ignored": but(
        "options-read", spec={"config": "rn_testing.fakes.backend:InstantOptions"}
    ),
    "close_needs_load": but(
        "close-before-load", close=lambda s, call: call() if s._decoder else s.run("")
    ),
    "close_leaves_a_thread": but(
        "close-releases", load=lambda s, call, *a: then(call(*a), leave_thread())
    ),
    "close_takes_20_s": but(
        "close-releases", "close did not return", case={"limits_s": {"close": 0.3}}, close=forever
    ),
    "second_load_starts_another_thread": but(
        "second-load-safe",
        load=lambda s, call, *a: then(call(*a), leave_thread() if counted(s) > 1 else 0),
    ),
    "load_after_close_is_half": but(
        "load-after-close", load=lambda s, call, *a: call(*a) if counted(s) < 2 else None
    ),
    "every_request_is_kept": but(
        "memory-bounded", run=lambda s, call, r: then(remembered(s, [r] * 99), call(r))
    ),
    "run_hangs": but(
        "run-answers",
        "run did not return within 0.3 s",
        case={"limits_s": {"run": 0.3}},
        run=forever,
    ),
    "run_is_slow": but(
        "run-quick",
        case={"run_limit_s": 0.05},
        run=lambda s, call, r: then(time.sleep(0.2), call(r)),
    ),
    "runs_before_load": but(
        "run-before-load-refused", run=lambda s, call, r: or_else(lambda: call(r), lambda: 4)
    ),
    "runs_after_close": but("run-after-close-refused", close=lambda s, call: None),
    "wrong_error_before_load": but(
        "run-before-load-refused", run=lambda s, call, r: call(r) if s._decoder else s.engine
    ),
    "no_family": but("families-declared", spec={"families": ()}),
    "answers_nothing": but("run-answers", run=lambda s, call, r: then(call(r), None)),
    "answers_once": but("run-answers", run=lambda s, call, r: call(r) if counted(s) < 2 else None),
    "wrong_answer": but("run-expected", run=lambda s, call, r: call(r) + 1),
    "noise": but("run-repeatable", run=lambda s, call, r: call(r) + noise(1.0)),
    "cache_leaks_into_the_next_request": but("run-repeatable", run=leaking),
    "refused_request_leaves_a_trace": but("run-repeatable", run=left_by_refusal),
    "noise_of_the_instance": but(
        "instances-agree",
        load=lambda s, call, *a: then(
            call(*a), setattr(s, "seed", time.perf_counter_ns() % 99_991)
        ),
        run=lambda s, call, r: call(r) + s.seed,
    ),
    "answers_share_one_buffer": but("answer-kept", case={"expected": None}, run=shared_list),
    "bad_request_answered": but(
        "bad-request-refused", run=lambda s, call, r: or_else(lambda: call(r), lambda: 4)
    ),
    "bad_request_crashes": but(
        "bad-request-refused", "AttributeError", run=lambda s, call, r: then(r.split(), call(r))
    ),
    "bad_model_loaded": but("bad-model-refused", load=lambda s, call, m, a=None: call(str(m), a)),
    "bad_model_crashes": but(
        "bad-model-refused", "TypeError", load=lambda s, call, m, a=None: then(len(m), call(m, a))
    ),
    "acceleration_refused": but("acceleration-accepted", load=lambda s, call, m: call(m)),
    "acceleration_ignored": but(
        "acceleration-accepted", "never applied", load=lambda s, call, m, a=None: call(m)
    ),
    "acceleration_refusal_hidden": but("acceleration-accepted", "refuses", load=quiet_acceleration),
    "acceleration_of_all": Mutant(
        rule="runtime/acceleration-contained",
        target=mutate(Preset, load=global_preset, run=lambda s, call, r: call(r) * s.factor),
        case={"expected": None},
    ),
    "abort_hangs": but("abort-harmless", "abort", abort=forever),
    "abort_before_load_crashes": but(
        "abort-harmless", abort=lambda s, call: s._decoder.kept_fraction
    ),
    "abort_for_ever": but(
        "abort-harmless",
        abort=never_again,
        run=lambda s, call, r: None if getattr(s, "aborted", 0) else call(r),
    ),
    "abort_does_not_abort": but(
        "abort-ends-run",
        "goes on",
        case={"long_request": lambda: "long"},
        run=lambda s, call, r: forever() if r == "long" else call(r),
    ),
    "too_few_tokens": tokens("reply-complete", "asked for", run=lambda s, call, r: call(r)[:-1]),
    "prompt_written_to": tokens("input-kept", run=painted),
    "deadline_ignored": tokens(
        "deadline-kept", run=lambda s, call, r: call(replace(r, deadline_s=None))
    ),
}


def preset(rule, words="", *, spec=None, case=None, **changes):
    target = mutate(HalvingAcceleration, **changes) if changes else None
    return Mutant(
        rule=f"acceleration/{rule}", target=target, spec=spec or {}, case=case or {}, words=words
    )


def quarter(self, call, decoder):
    call(decoder)
    decoder.kept_fraction *= 0.5


def halves_again(self, call, decoder):
    before = decoder.kept_fraction
    call(decoder)
    decoder.kept_fraction = before / 2


def of_the_class(self, call, decoder):
    FakeDecoder.probe = counted(self) + time.perf_counter_ns()
    call(decoder)


def damages_foreign(self, call, decoder):
    if hasattr(decoder, "layers"):
        decoder.layers.append(1)
    call(decoder)


def broken_by_refusal(self, call, decoder):
    if not isinstance(decoder, FakeDecoder):
        self.broken = True
    if not getattr(self, "broken", False) or not isinstance(decoder, FakeDecoder):
        call(decoder)


ACCELERATIONS: dict[str, Mutant] = {
    "no_apply": Mutant(
        rule="acceleration/protocol", target=mutate(object, __init__=lambda *_: None)
    ),
    "no_capability": preset("needs-declared", spec={"capability": ""}),
    "no_family": preset("needs-declared", spec={"families": ()}),
    "constructor_reads_a_file": preset(
        "constructor-pure", __init__=lambda s, call, c: then(call(c), read_file())
    ),
    "constructor_starts_a_thread": preset(
        "constructor-pure", __init__=lambda s, call, c: then(call(c), leave_thread())
    ),
    "constructor_computes": preset(
        "constructor-pure", __init__=lambda s, call, c: then(call(c), compute())
    ),
    "options_ignored": preset(
        "options-read", spec={"config": "rn_testing.fakes.backend:InstantOptions"}
    ),
    "apply_fails": preset("applies", apply=lambda s, call, d: [][0]),
    "apply_hangs": preset(
        "applies", "apply did not return", case={"limits_s": {"apply": 0.3}}, apply=forever
    ),
    "apply_does_nothing": preset(
        "applies",
        "changed nothing",
        apply=lambda s, call, d: None if isinstance(d, FakeDecoder) else call(d),
    ),
    "apply_changes_a_copy": preset(
        "applies", apply=lambda s, call, d: call(FakeDecoder() if isinstance(d, FakeDecoder) else d)
    ),
    "apply_returns_a_decoder": preset("applies", apply=lambda s, call, d: then(call(d), d)),
    "apply_too_much": preset("applies", "expects", apply=quarter),
    "apply_once_only": preset(
        "applies-again", apply=lambda s, call, d: call(d) if counted(s) < 2 else None
    ),
    "apply_breaks_the_second_time": preset(
        "applies-again", apply=lambda s, call, d: call(d) if counted(s) < 2 else [][0]
    ),
    "apply_adds_up": preset("applies-once", apply=halves_again),
    "apply_adds_up_without_expectation": preset(
        "applies-once", case={"expected": None}, apply=halves_again
    ),
    "apply_changes_the_class": preset("contained", "class", apply=of_the_class),
    "foreign_decoder_accepted": preset(
        "foreign-decoder-refused",
        apply=lambda s, call, d: call(d) if isinstance(d, FakeDecoder) else None,
    ),
    "foreign_decoder_crashes": preset(
        "foreign-decoder-refused",
        "AttributeError",
        apply=lambda s, call, d: then(d.kept_fraction, call(d)),
    ),
    "none_accepted": preset(
        "foreign-decoder-refused", apply=lambda s, call, d: None if d is None else call(d)
    ),
    "foreign_decoder_changed": preset("foreign-decoder-refused", "changed", apply=damages_foreign),
    "refusal_breaks_it": preset("works-after-refusal", apply=broken_by_refusal),
    "decoders_kept": preset(
        "memory-bounded", apply=lambda s, call, d: then(call(d), remembered(s, [d] * 50))
    ),
}

MUTANTS = {f"runtime_{n}": m for n, m in RUNTIMES.items()} | {
    f"acceleration_{n}": m for n, m in ACCELERATIONS.items()
}


def __getattr__(name):
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target

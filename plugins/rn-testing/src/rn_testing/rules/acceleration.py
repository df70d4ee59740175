"""Rules of accelerations: they change the decoders they declare, only those, and refuse others."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any

from rn_testing.attempts import attempt
from rn_testing.cases import AccelerationCase
from rn_testing.deadline import bounded
from rn_testing.effects import check_memory, check_releases, expect_refusal
from rn_testing.lifecycle import ALONE, PURE, check_protocol, check_pure_constructor
from rn_testing.options import OPTIONS_READ, check_options_read
from rn_testing.process_state import find_changes
from rn_testing.rule import NotApplicable, Rule, require
from rn_testing.snapshots import snapshot
from roboneuron import Acceleration, ConfigurationError, InvalidInputError


class _Foreign:
    """A decoder of an unknown kind."""

    def __init__(self) -> None:
        self.layers: list[object] = []
        self.forward = "forward"


def _built(case: AccelerationCase) -> Acceleration[Any]:
    return bounded(attempt(case, case.build), case.limits_s)


def _decoder(case: AccelerationCase) -> Callable[[], object]:
    if case.decoder is None:
        raise NotApplicable("the case gives no decoder")
    return case.decoder


def _check_declared(case: AccelerationCase) -> None:
    require(bool(case.spec.families), "the descriptor declares no model family")
    require(
        bool(case.spec.capability), "the descriptor declares no capability it needs of a runtime"
    )


def _check_options(case: AccelerationCase) -> None:
    decoder = _decoder(case)()
    check_options_read(case, lambda build: attempt(case, build).apply(decoder))


def _check_apply(case: AccelerationCase) -> None:
    decoder = _decoder(case)()
    preset = _built(case)
    before = snapshot(decoder)
    result: object = preset.apply(decoder)  # type: ignore[func-returns-value]
    require(
        result is None,
        f"apply returned {type(result).__name__}; it changes the decoder that it is given",
    )
    require(snapshot(decoder) != before, "apply changed nothing in the decoder")
    if case.expected is not None:
        require(case.expected(decoder), "apply did not change the decoder as the case expects")


def _check_again(case: AccelerationCase) -> None:
    decoder = _decoder(case)
    preset = _built(case)
    first, second = decoder(), decoder()
    preset.apply(first)
    kept, before = snapshot(first), snapshot(second)
    preset.apply(second)
    require(snapshot(first) == kept, "apply to a second decoder changes the first one")
    require(snapshot(second) != before, "apply to a second decoder changed nothing in it")
    if case.expected is not None:
        require(
            case.expected(second), "apply did not change the second decoder as the case expects"
        )


def _check_twice(case: AccelerationCase) -> None:
    decoder = _decoder(case)()
    preset = _built(case)
    preset.apply(decoder)
    once = snapshot(decoder)
    for again in (preset, _built(case)):
        again.apply(decoder)
        if case.expected is not None:
            require(
                case.expected(decoder),
                "a second apply to a decoder does not give what the case expects",
            )
        else:
            require(
                snapshot(decoder) == once,
                "a second apply to a decoder changes it again",
            )


def _check_contained(case: AccelerationCase) -> None:
    decoder = _decoder(case)
    bystander, kind = decoder(), snapshot(vars(type(decoder())))
    before, fresh = snapshot(bystander), snapshot(decoder())
    # with random weights a new decoder cannot be compared with an older one
    differ = snapshot(decoder()) != fresh
    _built(case).apply(decoder())
    require(snapshot(bystander) == before, "apply changed a decoder that it was not given")
    require(
        differ or snapshot(decoder()) == fresh,
        "a decoder made after apply differs from one made before",
    )
    require(
        snapshot(vars(type(decoder()))) == kind,
        "apply changed the class of the decoder, and so every decoder",
    )


def _check_foreign(case: AccelerationCase) -> None:
    preset = _built(case)
    for foreign in (object(), None, "decoder", _Foreign()):
        before = snapshot(foreign)
        what = f"apply to an unknown decoder ({type(foreign).__name__})"
        expect_refusal(partial(preset.apply, foreign), what, InvalidInputError, ConfigurationError)
        require(snapshot(foreign) == before, f"{what} was refused but changed the decoder")


def _check_after_refusal(case: AccelerationCase) -> None:
    decoder = _decoder(case)()
    preset = _built(case)
    expect_refusal(lambda: preset.apply(object()), "apply to an unknown decoder")
    before = snapshot(decoder)
    preset.apply(decoder)
    require(snapshot(decoder) != before, "after a refusal apply changes nothing")


def _check_memory(case: AccelerationCase) -> None:
    """A used decoder must be freed once its owner releases it, because it may be gigabytes."""
    decoder = _decoder(case)
    preset = _built(case)
    seen = [decoder() for _ in range(2)]
    for one in seen:
        preset.apply(one)
    try:
        held = [weakref.ref(one) for one in seen]
    except TypeError:  # of a class with slots; then only its size can be measured
        check_memory(lambda: preset.apply(decoder()), "apply")
        return
    del one
    seen.clear()
    gc.collect()
    kept = sum(reference() is not None for reference in held)
    require(
        kept < len(held),
        f"{kept} of {len(held)} decoders are still held after `apply`, by preset or module",
    )


def _check_releases(case: AccelerationCase) -> None:
    decoder = _decoder(case)
    check_releases(lambda: _built(case).apply(decoder()), "apply()")


def _check_process(case: AccelerationCase) -> None:
    decoder = _decoder(case)
    changes = find_changes(lambda: _built(case).apply(decoder()))
    require(not changes, f"it {'; '.join(changes)}")


_SOURCE = "roboneuron.contract.protocols.Acceleration"


def _rule(
    name: str, text: str, source: str, check: Callable[[AccelerationCase], None]
) -> Rule[AccelerationCase]:
    return Rule(id=f"acceleration/{name}", text=text, source=source, check=check)


RULES: tuple[Rule[AccelerationCase], ...] = (
    _rule(
        "protocol",
        "It has the methods of Acceleration.",
        _SOURCE,
        lambda case: check_protocol(case, Acceleration),
    ),
    _rule(
        "needs-declared",
        "The descriptor names model families and the capability it needs.",
        "roboneuron.plugins.specs.AccelerationSpec",
        _check_declared,
    ),
    # must be the first to apply a preset: a change of a class happens once and cannot be detected
    # later
    _rule(
        "contained",
        "`apply` changes the decoder it is given and nothing else.",
        f"{_SOURCE}.apply",
        _check_contained,
    ),
    _rule("constructor-pure", PURE, "roboneuron.contract.protocols", check_pure_constructor),
    _rule("options-read", OPTIONS_READ, _SOURCE, _check_options),
    _rule(
        "applies",
        "`apply` changes a decoder that has the capability.",
        f"{_SOURCE}.apply",
        _check_apply,
    ),
    _rule(
        "applies-again",
        "One preset can be applied to a second decoder, and leaves the first as it is.",
        f"{_SOURCE}.apply",
        _check_again,
    ),
    _rule(
        "applies-once",
        "A second `apply` to one decoder adds nothing.",
        f"{_SOURCE}.apply",
        _check_twice,
    ),
    _rule(
        "foreign-decoder-refused",
        "A decoder that the preset does not know is refused and not changed.",
        f"{_SOURCE}.apply",
        _check_foreign,
    ),
    _rule(
        "works-after-refusal",
        "After a refusal `apply` works.",
        f"{_SOURCE}.apply",
        _check_after_refusal,
    ),
    _rule(
        "memory-bounded",
        "The preset does not keep the decoders.",
        f"{_SOURCE}.apply",
        _check_memory,
    ),
    _rule(
        "releases",
        "`apply` leaves no thread, process or open file behind.",
        f"{_SOURCE}.apply",
        _check_releases,
    ),
    _rule("process-left-alone", ALONE, f"{_SOURCE}.apply", _check_process),
)
"""Rules of accelerations."""

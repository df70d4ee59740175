"""Rules of accelerations: they apply to the decoders they declare and refuse others."""

from __future__ import annotations

from roboneuron.contract import Acceleration
from roboneuron.testing.cases import AccelerationCase
from roboneuron.testing.effects import expect_refusal
from roboneuron.testing.lifecycle import attempt, check_protocol, check_pure_constructor
from roboneuron.testing.rule import NotApplicable, Rule, require


def _check_protocol(case: AccelerationCase) -> None:
    check_protocol(attempt(case, case.build), Acceleration)


def _check_declared(case: AccelerationCase) -> None:
    require(bool(case.spec.families), "the descriptor declares no model family")
    require(bool(case.spec.capability), "the descriptor declares no capability it needs of a runtime")


def _check_pure(case: AccelerationCase) -> None:
    check_pure_constructor(case, case.build)


def _check_apply(case: AccelerationCase) -> None:
    if case.decoder is None:
        raise NotApplicable("the case gives no decoder")
    attempt(case, case.build).apply(case.decoder())


def _check_fresh(case: AccelerationCase) -> None:
    if case.decoder is None:
        raise NotApplicable("the case gives no decoder")
    preset = attempt(case, case.build)
    preset.apply(case.decoder())
    preset.apply(case.decoder())


def _check_foreign(case: AccelerationCase) -> None:
    preset = attempt(case, case.build)
    expect_refusal(lambda: preset.apply(object()), "apply to an unknown decoder")


_SOURCE = "roboneuron.contract.protocols.Acceleration"

RULES: tuple[Rule[AccelerationCase], ...] = (
    Rule(id="acceleration/protocol", text="It has the methods of Acceleration.", source=_SOURCE, check=_check_protocol),
    Rule(
        id="acceleration/needs-declared",
        text="The descriptor names model families and the capability it needs.",
        source="roboneuron.plugins.specs.AccelerationSpec",
        check=_check_declared,
    ),
    Rule(
        id="acceleration/constructor-pure",
        text="The constructor opens no file, starts no thread or process and computes nothing that takes time.",
        source="roboneuron.contract.protocols",
        check=_check_pure,
    ),
    Rule(
        id="acceleration/applies",
        text="`apply` accepts a decoder that has the capability.",
        source=f"{_SOURCE}.apply",
        check=_check_apply,
    ),
    Rule(
        id="acceleration/applies-again",
        text="One preset can be applied to a second decoder.",
        source=f"{_SOURCE}.apply",
        check=_check_fresh,
    ),
    Rule(
        id="acceleration/foreign-decoder-refused",
        text="A decoder that the preset does not know is refused.",
        source=f"{_SOURCE}.apply",
        check=_check_foreign,
    ),
)
"""Rules of accelerations."""

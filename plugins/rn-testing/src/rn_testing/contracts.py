"""Contract classes: pytest test classes for third parties to subclass, with the single fixture
`plugin`.
"""

from __future__ import annotations

import pytest

from rn_testing.cases import CASES, PackageCase
from rn_testing.kinds import kind_of
from rn_testing.rule import AnyRule, RuleVerdict
from rn_testing.rules import RULES
from rn_testing.verification import verify
from roboneuron import PluginError, Spec


def _report(rule: AnyRule, case: object) -> None:
    __tracebackhide__ = True
    outcome = verify(rule, case)
    if outcome.verdict is RuleVerdict.SKIPPED:
        pytest.skip(f"{rule.id}: {outcome.detail}")
    if outcome.verdict is RuleVerdict.FAILED:
        text = (
            f"{rule.id}: {outcome.detail}\n  rule: {rule.text}\n  source: "
            f"{rule.source}\n{outcome.traceback}"
        )
        pytest.fail(text.rstrip(), pytrace=False)


class Contract:
    """Base of the contract classes: override `plugin`, and every rule of the kind becomes a
    test.
    """

    @pytest.fixture
    def plugin(self) -> object:
        """The case to test."""
        raise NotImplementedError(
            f"override the fixture `plugin` and return a case, see {type(self).__mro__[1]}"
        )


def _contract(kind: str, case: type[object], rules: tuple[AnyRule, ...] = ()) -> type[Contract]:
    rules = rules or RULES[kind]

    @pytest.mark.parametrize("rule", rules, ids=[rule.id for rule in rules])
    def test_contract(self: Contract, rule: AnyRule, plugin: object) -> None:
        """The rule holds."""
        _report(rule, plugin)

    text = (
        f"Subclass as `TestX`, override `plugin` and return a {case.__name__}; every rule "
        "becomes a test."
    )
    name = f"{kind.capitalize()}Contract"
    return type(
        name, (Contract,), {"__doc__": text, "__module__": __name__, "test_contract": test_contract}
    )


def contract_of(spec: type[Spec]) -> type[Contract]:
    """Contract class for a kind provided by another plugin, from its descriptor class."""
    kind = kind_of(spec)
    if kind is None:
        raise PluginError(f"{spec.__name__} names no rules: give it `rules`, see rn_testing.kinds.")
    return _contract(spec.kind, kind.case, kind.rules)


BackendContract = _contract("backend", CASES["backend"])
RuntimeContract = _contract("runtime", CASES["runtime"])
AccelerationContract = _contract("acceleration", CASES["acceleration"])
PerceptionContract = _contract("perception", CASES["perception"])
ControllerContract = _contract("controller", CASES["controller"])
RobotContract = _contract("robot", CASES["robot"])
LocatorContract = _contract("locator", CASES["locator"])
FeatureContract = _contract("feature", CASES["feature"])
CommandContract = _contract("command", CASES["command"])
PackageContract = _contract("package", PackageCase)

"""Contract classes: pytest test classes that a third party subclasses, with the one fixture `plugin`."""

from __future__ import annotations

from typing import Any

import pytest

from rn_testing.cases import CASES, PackageCase
from rn_testing.rule import Rule, Verdict, verify
from rn_testing.rules import RULES


def _report(rule: Rule[Any], case: Any) -> None:
    __tracebackhide__ = True
    outcome = verify(rule, case)
    if outcome.verdict is Verdict.SKIPPED:
        pytest.skip(f"{rule.id}: {outcome.detail}")
    if outcome.verdict is Verdict.FAILED:
        text = f"{rule.id}: {outcome.detail}\n  rule: {rule.text}\n  source: {rule.source}\n{outcome.traceback}"
        pytest.fail(text.rstrip(), pytrace=False)


class Contract:
    """Base of the contract classes: override `plugin`, and every rule of the kind becomes a test."""

    @pytest.fixture
    def plugin(self) -> Any:
        """The case to test."""
        raise NotImplementedError(f"override the fixture `plugin` and return a case, see {type(self).__mro__[1]}")


def _contract(kind: str, case: type[Any]) -> type[Contract]:
    rules = RULES[kind]

    @pytest.mark.parametrize("rule", rules, ids=[rule.id for rule in rules])
    def test_contract(self: Contract, rule: Rule[Any], plugin: Any) -> None:
        """The rule holds."""
        _report(rule, plugin)

    text = f"Subclass as `TestX`, override `plugin` and return a {case.__name__}; every rule becomes a test."
    name = f"{kind.capitalize()}Contract"
    return type(name, (Contract,), {"__doc__": text, "__module__": __name__, "test_contract": test_contract})


BackendContract = _contract("backend", CASES["backend"])
RuntimeContract = _contract("runtime", CASES["runtime"])
AccelerationContract = _contract("acceleration", CASES["acceleration"])
PerceptionContract = _contract("perception", CASES["perception"])
ControllerContract = _contract("controller", CASES["controller"])
RobotContract = _contract("robot", CASES["robot"])
FeatureContract = _contract("feature", CASES["feature"])
CommandContract = _contract("command", CASES["command"])
PackageContract = _contract("package", PackageCase)

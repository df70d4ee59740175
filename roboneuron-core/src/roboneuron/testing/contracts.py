"""Contract classes: pytest test classes that a third party subclasses, with the one fixture `plugin`."""

from __future__ import annotations

from typing import Any

import pytest

from roboneuron.testing.cases import (
    AccelerationCase,
    BackendCase,
    CommandCase,
    ControllerCase,
    FeatureCase,
    PackageCase,
    PerceptionCase,
    RobotCase,
    RuntimeCase,
)
from roboneuron.testing.rule import Rule, Verdict, verify
from roboneuron.testing.rules import RULES


def _for_each_rule(kind: str) -> pytest.MarkDecorator:
    rules = RULES[kind]
    return pytest.mark.parametrize("rule", rules, ids=[rule.id for rule in rules])


def _report(rule: Rule[Any], case: Any) -> None:
    __tracebackhide__ = True
    outcome = verify(rule, case)
    if outcome.verdict is Verdict.SKIPPED:
        pytest.skip(f"{rule.id}: {outcome.detail}")
    if outcome.verdict is Verdict.FAILED:
        text = f"{rule.id}: {outcome.detail}\n  rule: {rule.text}\n  source: {rule.source}\n{outcome.traceback}"
        pytest.fail(text.rstrip(), pytrace=False)


class BackendContract:
    """Subclass as `TestX` and override `plugin`; every rule of backends becomes a test."""

    @pytest.fixture
    def plugin(self) -> BackendCase:
        """The backend to test."""
        raise NotImplementedError("override the fixture `plugin` and return a BackendCase")

    @_for_each_rule("backend")
    def test_contract(self, rule: Rule[BackendCase], plugin: BackendCase) -> None:
        """The rule holds."""
        _report(rule, plugin)


class RuntimeContract:
    """Subclass as `TestX` and override `plugin`; every rule of runtimes becomes a test."""

    @pytest.fixture
    def plugin(self) -> RuntimeCase:
        """The runtime to test."""
        raise NotImplementedError("override the fixture `plugin` and return a RuntimeCase")

    @_for_each_rule("runtime")
    def test_contract(self, rule: Rule[RuntimeCase], plugin: RuntimeCase) -> None:
        """The rule holds."""
        _report(rule, plugin)


class AccelerationContract:
    """Subclass as `TestX` and override `plugin`; every rule of accelerations becomes a test."""

    @pytest.fixture
    def plugin(self) -> AccelerationCase:
        """The acceleration to test."""
        raise NotImplementedError("override the fixture `plugin` and return an AccelerationCase")

    @_for_each_rule("acceleration")
    def test_contract(self, rule: Rule[AccelerationCase], plugin: AccelerationCase) -> None:
        """The rule holds."""
        _report(rule, plugin)


class PerceptionContract:
    """Subclass as `TestX` and override `plugin`; every rule of perception sources becomes a test."""

    @pytest.fixture
    def plugin(self) -> PerceptionCase:
        """The source to test."""
        raise NotImplementedError("override the fixture `plugin` and return a PerceptionCase")

    @_for_each_rule("perception")
    def test_contract(self, rule: Rule[PerceptionCase], plugin: PerceptionCase) -> None:
        """The rule holds."""
        _report(rule, plugin)


class ControllerContract:
    """Subclass as `TestX` and override `plugin`; every rule of controllers becomes a test."""

    @pytest.fixture
    def plugin(self) -> ControllerCase:
        """The controller to test."""
        raise NotImplementedError("override the fixture `plugin` and return a ControllerCase")

    @_for_each_rule("controller")
    def test_contract(self, rule: Rule[ControllerCase], plugin: ControllerCase) -> None:
        """The rule holds."""
        _report(rule, plugin)


class RobotContract:
    """Subclass as `TestX` and override `plugin`; every rule of robots and of the one driver becomes a test."""

    @pytest.fixture
    def plugin(self) -> RobotCase:
        """The robot to test."""
        raise NotImplementedError("override the fixture `plugin` and return a RobotCase")

    @_for_each_rule("robot")
    def test_contract(self, rule: Rule[RobotCase], plugin: RobotCase) -> None:
        """The rule holds."""
        _report(rule, plugin)


class FeatureContract:
    """Subclass as `TestX` and override `plugin`; every rule of features becomes a test."""

    @pytest.fixture
    def plugin(self) -> FeatureCase:
        """The feature to test."""
        raise NotImplementedError("override the fixture `plugin` and return a FeatureCase")

    @_for_each_rule("feature")
    def test_contract(self, rule: Rule[FeatureCase], plugin: FeatureCase) -> None:
        """The rule holds."""
        _report(rule, plugin)


class CommandContract:
    """Subclass as `TestX` and override `plugin`; every rule of commands becomes a test."""

    @pytest.fixture
    def plugin(self) -> CommandCase:
        """The command to test."""
        raise NotImplementedError("override the fixture `plugin` and return a CommandCase")

    @_for_each_rule("command")
    def test_contract(self, rule: Rule[CommandCase], plugin: CommandCase) -> None:
        """The rule holds."""
        _report(rule, plugin)


class PackageContract:
    """Subclass as `TestX` and override `plugin`; every rule of packages becomes a test."""

    @pytest.fixture
    def plugin(self) -> PackageCase:
        """The distribution to test."""
        raise NotImplementedError("override the fixture `plugin` and return a PackageCase")

    @_for_each_rule("package")
    def test_contract(self, rule: Rule[PackageCase], plugin: PackageCase) -> None:
        """The rule holds."""
        _report(rule, plugin)

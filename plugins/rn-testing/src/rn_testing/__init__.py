"""The contract kit: subclass the class of a kind and provide one fixture to test every rule of that
kind.

    from rn_testing import BackendCase, BackendContract

    class TestMyPolicy(BackendContract):
        @pytest.fixture
        def plugin(self) -> BackendCase:
            return BackendCase(spec=MY_POLICY)

Only the contract classes need pytest; rules, cases and fakes do not. Names are imported on first
access, so that the plugin module of this package stays light. Production code must not import this
package.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rn_testing.cases import (
        AccelerationCase,
        BackendCase,
        Case,
        CommandCase,
        ControllerCase,
        FeatureCase,
        LocatorCase,
        PackageCase,
        PerceptionCase,
        RobotCase,
        RuntimeCase,
    )
    from rn_testing.contracts import (
        AccelerationContract,
        BackendContract,
        CommandContract,
        ControllerContract,
        FeatureContract,
        LocatorContract,
        PackageContract,
        PerceptionContract,
        RobotContract,
        RuntimeContract,
    )
    from rn_testing.rule import NotApplicable, Rule, RuleVerdict, Violation
    from rn_testing.verification import RuleResult, verify

__all__ = [
    "AccelerationCase",
    "AccelerationContract",
    "BackendCase",
    "BackendContract",
    "Case",
    "CommandCase",
    "CommandContract",
    "ControllerCase",
    "ControllerContract",
    "FeatureCase",
    "FeatureContract",
    "LocatorCase",
    "LocatorContract",
    "NotApplicable",
    "PackageCase",
    "PackageContract",
    "PerceptionCase",
    "PerceptionContract",
    "RobotCase",
    "RobotContract",
    "Rule",
    "RuleResult",
    "RuleVerdict",
    "RuntimeCase",
    "RuntimeContract",
    "Violation",
    "verify",
]


def __getattr__(name: str) -> object:
    """Import a public name on first access."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    suffixes = {
        "Case": "cases",
        "Contract": "contracts",
        "RuleResult": "verification",
        "verify": "verification",
    }
    module = next((place for suffix, place in suffixes.items() if name.endswith(suffix)), "rule")
    return getattr(import_module(f"{__name__}.{module}"), name)

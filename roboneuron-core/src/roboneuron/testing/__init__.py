"""The contract kit: subclass one class per kind, give one fixture, and every rule of that kind is tested.

    from roboneuron.testing import BackendCase, BackendContract

    class TestMyPolicy(BackendContract):
        @pytest.fixture
        def plugin(self) -> BackendCase:
            return BackendCase(spec=MY_POLICY)

Only the contract classes need pytest (they are imported when first asked for); rules, cases and fakes do not. Nothing
in production imports this package.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from roboneuron.testing.cases import (
    AccelerationCase,
    BackendCase,
    Case,
    CommandCase,
    ControllerCase,
    FeatureCase,
    PackageCase,
    PerceptionCase,
    RobotCase,
    RuntimeCase,
)
from roboneuron.testing.rule import NotApplicable, Outcome, Rule, Verdict, Violation, verify

if TYPE_CHECKING:
    from roboneuron.testing.contracts import (
        AccelerationContract,
        BackendContract,
        CommandContract,
        ControllerContract,
        FeatureContract,
        PackageContract,
        PerceptionContract,
        RobotContract,
        RuntimeContract,
    )

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
    "NotApplicable",
    "Outcome",
    "PackageCase",
    "PackageContract",
    "PerceptionCase",
    "PerceptionContract",
    "RobotCase",
    "RobotContract",
    "Rule",
    "RuntimeCase",
    "RuntimeContract",
    "Verdict",
    "Violation",
    "verify",
]


def __getattr__(name: str) -> object:
    """The contract classes, which need pytest."""
    if name.endswith("Contract") and name in __all__:
        from roboneuron.testing import contracts

        return getattr(contracts, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

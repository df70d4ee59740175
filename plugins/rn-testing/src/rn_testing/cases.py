"""Cases: a descriptor, options with which it runs, and inputs for the rules of its kind.

The fixture of a contract class and a descriptor's `case` function return a case. All fields but
`spec` have defaults that suffice for a plugin that works with synthetic input.
"""

from __future__ import annotations

from rn_testing.case import Case
from rn_testing.device_cases import ControllerCase, PerceptionCase, RobotCase
from rn_testing.extension_cases import CommandCase, FeatureCase, PackageCase
from rn_testing.locator_case import LocatorCase
from rn_testing.model_cases import AccelerationCase, BackendCase, RuntimeCase
from roboneuron import Spec

__all__ = [
    "CASES",
    "AccelerationCase",
    "BackendCase",
    "Case",
    "CommandCase",
    "ControllerCase",
    "FeatureCase",
    "LocatorCase",
    "PackageCase",
    "PerceptionCase",
    "RobotCase",
    "RuntimeCase",
]

CASES: dict[str, type[Case[Spec]]] = {
    "backend": BackendCase,
    "runtime": RuntimeCase,
    "acceleration": AccelerationCase,
    "perception": PerceptionCase,
    "controller": ControllerCase,
    "robot": RobotCase,
    "locator": LocatorCase,
    "feature": FeatureCase,
    "command": CommandCase,
}
"""Case class by descriptor kind."""

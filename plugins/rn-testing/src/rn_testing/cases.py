"""Cases: a descriptor, options it can run with, and what the rules of its kind need to try it.

A case is what a contract class's one fixture returns and what a descriptor's `case` function
returns. Everything but `spec` has a default that suffices for a plugin that works with synthetic
input.
"""

from __future__ import annotations

from rn_testing.case import Case
from rn_testing.device_cases import ControllerCase, PerceptionCase, RobotCase
from rn_testing.extension_cases import CommandCase, FeatureCase, PackageCase
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
    "feature": FeatureCase,
    "command": CommandCase,
}
"""Case class by descriptor kind."""

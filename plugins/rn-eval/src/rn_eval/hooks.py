"""The hook for suites of tasks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from roboneuron import Spec, hookspec


@dataclass(frozen=True, kw_only=True, slots=True)
class SuiteSpec(Spec):
    """A suite of tasks in a simulation that is stepped by hand.

    Attributes:
        robot: name of the robot that acts; planning checks backend, cameras and controller against it.
        driver: the robot's driver whose requirements must be installed.
    """

    kind: ClassVar[str] = "suite"

    robot: str
    driver: str = "simulated"


@hookspec
def roboneuron_suites() -> Sequence[SuiteSpec]:  # type: ignore[empty-body]
    """Offer suites of tasks for `roboneuron eval`.

    `target` follows the protocol `rn_eval.suite.Suite`; it is built as `target(config)` in each worker.
    """


HOOKS = {"roboneuron_suites": SuiteSpec}
"""Descriptor class by hook."""

"""Every rule, by subject. `RULES["backend"]` are the rules a backend's contract class runs."""

from typing import Any

from roboneuron.testing.rule import Rule
from roboneuron.testing.rules import (
    acceleration,
    backend,
    controller,
    descriptor,
    driver,
    driver_motion,
    package,
    perception,
    robot,
    runtime,
)

RULES: dict[str, tuple[Rule[Any], ...]] = {
    "backend": (*descriptor.RULES, *backend.RULES),
    "runtime": (*descriptor.RULES, *runtime.RULES),
    "acceleration": (*descriptor.RULES, *acceleration.RULES),
    "perception": (*descriptor.RULES, *perception.RULES),
    "controller": (*descriptor.RULES, *controller.RULES),
    "robot": (*descriptor.RULES, *robot.RULES, *driver.RULES, *driver_motion.RULES),
    "package": package.RULES,
}
"""Rules by kind of descriptor, and those of packages."""

__all__ = ["RULES"]

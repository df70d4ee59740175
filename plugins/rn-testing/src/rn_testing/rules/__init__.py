"""All rules by subject. `RULES["backend"]` are those of a backend's contract class."""

from rn_testing.kinds import brought_kind
from rn_testing.rule import AnyRule
from rn_testing.rules import (
    acceleration,
    backend,
    backend_engine,
    backend_observation,
    backend_space,
    command,
    controller,
    controller_bounds,
    controller_memory,
    controller_space,
    descriptor,
    driver,
    driver_motion,
    driver_stops,
    feature,
    locator,
    package,
    package_imports,
    perception,
    perception_timing,
    restricted,
    robot,
    runtime,
)

OF_EVERY_DESCRIPTOR: tuple[AnyRule, ...] = (*descriptor.RULES, *restricted.RULES)
"""Rules for descriptors of any kind with options."""
RULES: dict[str, tuple[AnyRule, ...]] = {
    "backend": (
        *descriptor.RULES,
        *restricted.RULES,
        *backend.RULES,
        *backend_observation.RULES,
        *backend_space.RULES,
        *backend_engine.RULES,
    ),
    "runtime": (*descriptor.RULES, *restricted.RULES, *runtime.RULES),
    "acceleration": (*descriptor.RULES, *restricted.RULES, *acceleration.RULES),
    "perception": (
        *descriptor.RULES,
        *restricted.RULES,
        *perception.RULES,
        *perception_timing.RULES,
    ),
    "controller": (
        *descriptor.RULES,
        *restricted.RULES,
        *controller.RULES,
        *controller_bounds.RULES,
        *controller_memory.RULES,
        *controller_space.RULES,
    ),
    "robot": (
        *descriptor.RULES,
        *restricted.RULES,
        *robot.RULES,
        *driver.RULES,
        *driver_motion.RULES,
        *driver_stops.RULES,
    ),
    "locator": (*OF_EVERY_DESCRIPTOR, *locator.RULES),
    "feature": (*descriptor.RULES, *feature.RULES),
    "command": (*descriptor.RULES, *command.RULES),
    "package": (*package.RULES, *package_imports.RULES),
}
"""Rules by kind of descriptor, and those of packages."""


def rules_of(kind: str) -> tuple[AnyRule, ...]:
    """Rules of a kind of descriptor; for a kind from another plugin those that it names, and at
    least those of every descriptor.
    """
    if kind in RULES:
        return RULES[kind]
    brought = brought_kind(kind)
    return OF_EVERY_DESCRIPTOR if brought is None else brought.rules


__all__ = ["OF_EVERY_DESCRIPTOR", "RULES", "rules_of"]

"""Versions of everything that an episode's outcome depends on, and their changes since the start of
a run.
"""

from __future__ import annotations

import platform
import re
from collections.abc import Iterable, Mapping
from importlib.metadata import PackageNotFoundError, distribution

from rn_eval.plan import EvalPlan
from roboneuron.feature import Registry

CORE = "roboneuron-core"
SIMULATORS = ("pybullet", "mujoco")
LIBRARIES = ("numpy", "torch", "transformers", "tokenizers", "pillow", *SIMULATORS, "ray")
"""Packages outside RoboNeuron whose numerics affect an outcome."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def installed_versions(plan: EvalPlan, registry: Registry) -> dict[str, str]:
    """Versions by name in this process: Python, the libraries above, and the packages that provide
    the plan's parts (suite, backend, runtime, acceleration, controller, robot) with the RoboNeuron
    packages that they require.
    """
    wanted = [("suite", plan.suite)]
    for preset in plan.presets:
        parts = plan.check(registry, preset)
        controller = plan.controller(registry, parts.robot)
        specs = (parts.robot, parts.backend, parts.runtime, controller, parts.acceleration)
        wanted += [(spec.kind, spec.name) for spec in specs if spec is not None]
    offers = {
        (offer.spec.kind, offer.spec.name): offer.distribution for offer in registry.all_offers
    }
    brings = [offers[key] for key in dict.fromkeys(wanted) if offers.get(key)]
    return {"python": platform.python_version(), **package_versions(brings)}


def package_versions(packages: Iterable[str]) -> dict[str, str]:
    """Versions by name of these packages, the core, this one, the RoboNeuron packages that they
    require, and `LIBRARIES`.
    """
    found: dict[str, str] = {}
    for name in [*sorted(_own_packages([CORE, "rn-eval", *packages])), *LIBRARIES]:
        version = _version(name)
        if version:
            found[name] = version
    return found


def changed_versions(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Differences as "name 1.0 -> 1.1"; packages missing on one side are left out."""
    return [
        f"{name} {before[name]} -> {now[name]}"
        for name in before
        if name in now and before[name] != now[name]
    ]


def _own_packages(names: Iterable[str]) -> set[str]:
    """These packages, and those of their requirements that themselves require RoboNeuron's core."""
    found: set[str] = set()
    pending = list(names)
    while pending:
        name = pending.pop()
        if name in found:
            continue
        required = _required(name)
        if name == CORE or CORE in required:
            found.add(name)
            pending += required
    return found


def _required(name: str) -> list[str]:
    """Names of the packages that a package requires without an extra."""
    try:
        lines = distribution(name).requires or []
    except PackageNotFoundError:
        return []
    matches = [_NAME.match(line) for line in lines if "extra ==" not in line]
    return [match[0] for match in matches if match is not None]


def _version(name: str) -> str:
    try:
        return distribution(name).version
    except PackageNotFoundError:
        return ""

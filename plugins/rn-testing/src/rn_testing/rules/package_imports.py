"""Rules on imports of a package: from the core, from other plugins, and from its requirements."""

from __future__ import annotations

import ast
import functools
import re
import sys
from collections.abc import Collection, Mapping
from importlib.metadata import (
    PackageNotFoundError,
    distribution,
    distributions,
    packages_distributions,
)
from pathlib import Path

import roboneuron
from rn_testing.cases import PackageCase
from rn_testing.distribution import (
    LISTS,
    PROJECT,
    find_distribution,
    find_entry_points,
    find_package_directory,
    hosted_directories,
    imported_modules,
    normalise,
    requirements,
    source_files,
)
from rn_testing.kinds import named_by
from rn_testing.rule import Rule, require
from rn_testing.rules import installed
from rn_testing.rules.package import CORE, PAGE
from roboneuron import CommandSpec, FeatureSpec, Spec

KIT = "rn-testing"
"""Distribution of the contract kit."""
HOUSE = "rn-standard"
"""Distribution that is released with the core and may import all of it: what only it needs is not
public.
"""


def lists_for(*, features: bool, commands: bool, is_kit: bool = False) -> frozenset[str]:
    """Names in `LISTS` that a plugin may use, depending on whether its offers run in the server or
    in modules, or as a separate process. The contract kit may use all of them.
    """
    if commands or is_kit:
        return frozenset(LISTS)
    return frozenset({"roboneuron.feature"} if features else ())


@functools.cache
def published(module: str) -> frozenset[str]:
    """Names in the literal `__all__` of a module of the core: other distributions may use them.
    Empty without one, and for packages. The module is not imported.
    """
    path = Path(roboneuron.__file__).parents[1].joinpath(*module.split(".")).with_suffix(".py")
    if not path.is_file():
        return frozenset()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return frozenset(ast.literal_eval(node.value))
    return frozenset()


def is_public(name: str, lists: Collection[str]) -> bool:
    """True if a plugin may import `name`: `roboneuron.<name>`, names in these lists, and names that
    a module of the core publishes in `__all__`.

    Args:
        name: as returned by `imported_modules`.
        lists: allowed keys of `LISTS`.
    """
    top, *inner = name.split(".")
    if top != PROJECT or not inner:
        return True
    of = f"{top}.{inner[0]}"
    if of not in LISTS:
        module, _, last = name.rpartition(".")
        is_published = last in published(module) or bool(published(name))
        return is_published or (len(inner) == 1 and inner[0] in roboneuron.__all__)
    name, used = [*inner[1:], "", ""][:2]
    is_listed = not name or name in LISTS[of].__all__
    is_open = not used or used in LISTS[of].GROUPS.get(name, ())
    return of in lists and is_listed and is_open


def _check_direction(case: PackageCase) -> None:
    specs = tuple(installed.specs_of(case))
    distribution = normalise(case.distribution)
    if distribution == HOUSE:
        return
    lists = lists_for(
        features=any(isinstance(spec, FeatureSpec) for spec in specs),
        commands=any(isinstance(spec, CommandSpec) for spec in specs),
        is_kit=distribution == KIT,
    )
    where = ", ".join(["roboneuron", *sorted(lists)])
    for path in source_files(case):
        for name, line in imported_modules(path):
            require(
                is_public(name, lists),
                f"{path.name}:{line} imports {name}; of the core this plugin may import what "
                f"{where} list",
            )


def _check_siblings(case: PackageCase) -> None:
    """Other plugins may be imported only if declared."""
    owners = {
        point.module.partition(".")[0]: normalise(found.name)
        for found in distributions()
        for point in found.entry_points
        if point.group == PROJECT
    }
    declared = requirements(case) | {normalise(case.distribution)}
    for path in source_files(case):
        for name, line in imported_modules(path):
            owner = owners.get(name.partition(".")[0])
            require(
                owner is None or owner in declared,
                f"{path.name}:{line} imports {name} of {owner}, not declared",
            )


def _check_kit(case: PackageCase) -> None:
    """The kit is missing when users run a plugin that requires it only in an extra."""
    needed = {
        normalise(line) for line in find_distribution(case).requires or () if "extra ==" not in line
    }
    if normalise(case.distribution) == KIT or any(line.startswith(KIT) for line in needed):
        return
    cases = {
        str(spec.case).partition(":")[0]
        for spec in installed.specs_of(case)
        if isinstance(spec, Spec)
    }
    cases |= {named_by(kind).partition(":")[0] for kind in installed.plugins().kinds.values()}
    roots = [find_package_directory(case, point.module).parent for point in find_entry_points(case)]
    for path in source_files(case):
        module = next(
            ".".join(path.relative_to(r).with_suffix("").parts)
            for r in roots
            if path.is_relative_to(r)
        )
        for name, line in imported_modules(path):
            allowed = module in cases or name.partition(".")[0] != __name__.partition(".")[0]
            require(
                allowed,
                f"{path.name}:{line} imports {name}, which only the module of a `case` or of "
                "`rules` may",
            )


def _check_imports_declared(case: PackageCase) -> None:
    """Imports must be provided by declared requirements, directly or indirectly, or by a
    descriptor's `requires`.

    A subpackage that another program loads through its own entry point may use what that program
    requires.
    """
    owners = _owners(tuple(sys.path))
    own = {point.module.partition(".")[0] for point in find_entry_points(case)}
    declared = requirements(case) | {normalise(case.distribution)}
    reachable = set(declared)
    for name in (*declared, CORE):
        reachable |= _needs(name)
    promised = {r.module for spec in installed.specs_of(case) for r in spec.requires}
    hosted = tuple(hosted_directories(case))
    for path in source_files(case):
        if any(path.is_relative_to(directory) for directory in hosted):
            continue
        for name, line in imported_modules(path):
            top = name.partition(".")[0]
            if top in own or top in sys.stdlib_module_names or top in promised or top == PROJECT:
                continue
            of = {normalise(owner) for owner in owners.get(top, ())}
            require(
                not of or bool(of & reachable),
                f"{path.name}:{line} imports {top} of {', '.join(of)}, not declared",
            )


@functools.lru_cache(maxsize=4)
def _owners(path: tuple[str, ...]) -> Mapping[str, list[str]]:
    """Distributions by their top-level packages; cached, because reading them takes a second per
    path.
    """
    return packages_distributions()


@functools.cache
def _needs(name: str) -> frozenset[str]:
    """Normalised names of all direct and indirect requirements of a distribution, without
    extras.
    """
    found: set[str] = set()
    waiting = [name]
    while waiting:
        try:
            lines = distribution(waiting.pop()).requires or ()
        except PackageNotFoundError:
            continue
        for line in lines:
            needed = normalise(re.split(r"[^A-Za-z0-9._-]", line.strip(), maxsplit=1)[0])
            if "extra ==" not in line and needed not in found:
                found.add(needed)
                waiting.append(needed)
    return frozenset(found)


RULES: tuple[Rule[PackageCase], ...] = (
    Rule(
        id="package/import-direction",
        text="Of the core it imports what `roboneuron` and the `__all__` of a module list; with "
        "features or commands, `roboneuron.feature` too; with commands, `roboneuron.command`.",
        source=PAGE,
        check=_check_direction,
    ),
    Rule(
        id="package/siblings-declared",
        text="It imports other plugins only when it declares to need them.",
        source=PAGE,
        check=_check_siblings,
    ),
    Rule(
        id="package/kit-in-cases-only",
        text=f"Only modules that a descriptor's `case` or `rules` names import {KIT}, unless it "
        "depends on it.",
        source=PAGE,
        check=_check_kit,
    ),
    Rule(
        id="package/imports-declared",
        text="What it imports comes with a distribution that it declares, or with a descriptor's "
        "`requires`.",
        source=PAGE,
        check=_check_imports_declared,
    ),
)
"""Rules of packages on imports."""

"""Rules of packages: what a user of pip, a type checker and the registry may rely on."""

from __future__ import annotations

import functools
import re
import sys
from collections.abc import Collection, Iterator, Mapping
from importlib.metadata import (
    PackageNotFoundError,
    distribution,
    distributions,
    packages_distributions,
)

import roboneuron
from rn_testing.cases import PackageCase
from rn_testing.distribution import (
    LISTS,
    PROJECT,
    find_distribution,
    find_entry_points,
    find_package,
    find_package_directory,
    header,
    hosted_directories,
    imported_modules,
    normalise,
    probe,
    requirements,
    source_files,
)
from rn_testing.kinds import named_by
from rn_testing.rule import Rule, require
from rn_testing.unsafe_calls import unsafe_calls
from roboneuron import CommandSpec, DriverSpec, FeatureSpec, RobotSpec, Spec
from roboneuron.feature import Registry, discover

SENDING_NAME = "RosLink"
"""What joins the ROS graph and could send past the gate: for commands, which are processes of their
own, and for the plugin of the direct path.
"""
SENDER = ("rn-standard", "rn-direct-path")
"""Distribution and plugin of the gate: the one feature that sends, since all others send through
it.
"""
SENDER_PACKAGE = "rn_standard.direct_path"
"""The package of that plugin."""
CORE = "roboneuron-core"
"""Distribution that every plugin needs."""
KIT = "rn-testing"
"""Distribution of the contract kit."""


def _check_entry_point(case: PackageCase) -> None:
    for point in find_entry_points(case):
        directory = find_package_directory(case, point.module)
        inner = point.module.split(".")[1:]
        place = directory.joinpath(*inner)
        exists = place.with_suffix(".py").is_file() or (place / "__init__.py").is_file()
        require(
            exists, f"the entry point names {point.module!r}, which {directory.name} does not hold"
        )
        require(
            not point.attr,
            f"the entry point is {point.value!r}, expected a module without attribute",
        )


def _check_hooks(case: PackageCase) -> None:
    for point in find_entry_points(case):
        problem = probe(case, point.module).problem
        require(not problem, f"{point.module}: {problem}")


def _check_light(case: PackageCase) -> None:
    # a suite's descriptor
    brought = {spec.__module__.rpartition(".")[0] for spec in _installed().kinds.values()}
    for point in find_entry_points(case):
        packages = brought | {find_package(case, point.module)}
        heavy = {_foreign(name, packages) for name in probe(case, point.module).loaded} - {""}
        require(not heavy, f"importing {point.module} imports {', '.join(sorted(heavy))}")


def _foreign(module: str, packages: Collection[str]) -> str:
    """What a plugin module should not load with itself: another package, or a plugin beside it;
    empty when it may.

    Args:
        module: name of a module that was loaded.
        packages: what it may load, besides the core, pluggy and the standard library.
    """
    top = module.partition(".")[0]
    if top in sys.stdlib_module_names | {PROJECT, "pluggy"} or top.startswith("__"):
        return ""
    if any(
        f"{module}.".startswith(f"{package}.") or package.startswith(f"{module}.")
        for package in packages
    ):
        return ""
    beside = any(package.partition(".")[0] == top for package in packages)
    return ".".join(module.split(".")[:2]) if beside else top


def _check_pure(case: PackageCase) -> None:
    for point in find_entry_points(case):
        effects = probe(case, point.module).effects
        require(not effects, f"importing {point.module} has effects: {'; '.join(effects)}")


def _check_typed(case: PackageCase) -> None:
    for point in find_entry_points(case):
        directory = find_package_directory(case, point.module)
        require((directory / "py.typed").is_file(), f"{directory.name} holds no file py.typed")


def _check_readme(case: PackageCase) -> None:
    text = header(case, "Description") or str(find_distribution(case).metadata.get_payload() or "")  # type: ignore[attr-defined]
    require(bool(text.strip()), "the metadata hold no README")


def _check_summary(case: PackageCase) -> None:
    require(bool(header(case, "Summary")), "the metadata hold no summary")


def _check_licence(case: PackageCase) -> None:
    named = header(case, "License-Expression") or header(case, "License")
    require(bool(named), "the metadata name no licence")
    found = find_distribution(case)
    files = [str(name) for name in found.metadata.get_all("License-File") or ()]
    require(bool(files), "the distribution holds no licence file")
    texts = [found.read_text(f"licenses/{name}") or found.read_text(name) for name in files]
    require(
        all(text and text.strip() for text in texts),
        f"the distribution lacks the text of {', '.join(files)}",
    )


def _check_python(case: PackageCase) -> None:
    text = header(case, "Requires-Python")
    require(bool(text), "the metadata hold no Requires-Python")
    require(">" in text, f"Requires-Python is {text!r}, expected a lower bound such as >=3.11")


def _check_core(case: PackageCase) -> None:
    require(CORE in requirements(case), f"the distribution does not require {CORE}")
    lines = [
        line for line in find_distribution(case).requires or () if normalise(line).startswith(CORE)
    ]
    plain = [line for line in lines if "extra ==" not in line]
    require(bool(plain), f"the distribution requires {CORE} only in an extra")
    require(
        any(">" in line and "<" in line for line in plain),
        f"{plain[0]!r} has no lower or no upper bound",
    )


def lists_for(*, features: bool, commands: bool, is_kit: bool = False) -> frozenset[str]:
    """Which of `LISTS` a plugin may use: what it offers runs in the server, in modules, or as a
    process of its own. The contract kit tries all of these.
    """
    lists = {"roboneuron.feature", "roboneuron.node"} if features or is_kit else set()
    return frozenset(lists | ({"roboneuron.command"} if commands or is_kit else set()))


def is_public(name: str, lists: Collection[str], *, sends: bool = False) -> bool:
    """Whether a plugin may import what `name` means: `roboneuron.<name>`, and what these lists
    hold.

    Args:
        name: as `imported_modules` gives it.
        lists: of `LISTS`.
        sends: it is the direct path.
    """
    top, *inner = name.split(".")
    if top != PROJECT or not inner:
        return True
    of = f"{top}.{inner[0]}"
    if of not in LISTS:
        return len(inner) == 1 and inner[0] in roboneuron.__all__
    name, used = [*inner[1:], "", ""][:2]
    is_listed = not name or name in LISTS[of].__all__
    is_open = not used or used in LISTS[of].GROUPS.get(name, ())
    may_send = sends or of != "roboneuron.feature" or name != SENDING_NAME
    return of in lists and is_listed and is_open and may_send


def _check_direction(case: PackageCase) -> None:
    specs = tuple(_specs(case))
    distribution = normalise(case.distribution)
    lists = lists_for(
        features=any(isinstance(spec, FeatureSpec) for spec in specs),
        commands=any(isinstance(spec, CommandSpec) for spec in specs),
        is_kit=distribution == KIT,
    )
    where = ", ".join(["roboneuron", *sorted(lists)])
    for path in source_files(case):
        for name, line in imported_modules(path):
            require(
                is_public(name, lists, sends=(distribution, case.plugin) == SENDER),
                f"{path.name}:{line} imports {name}; of the core this plugin may import what "
                f"{where} list",
            )


def _check_siblings(case: PackageCase) -> None:
    """Another plugin may be imported only when it is declared."""
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
    """The kit is not there when users run a plugin that names it in an extra only."""
    needed = {
        normalise(line) for line in find_distribution(case).requires or () if "extra ==" not in line
    }
    if normalise(case.distribution) == KIT or any(line.startswith(KIT) for line in needed):
        return
    cases = {str(spec.case).partition(":")[0] for spec in _specs(case) if isinstance(spec, Spec)}
    cases |= {named_by(kind).partition(":")[0] for kind in _installed().kinds.values()}
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
    """What is imported comes with what is declared, directly or by way of it, or with a
    descriptor's `requires`.

    A subpackage that another program loads by an entry point of its own runs with what that program
    has installed.
    """
    owners = _owners(tuple(sys.path))
    own = {point.module.partition(".")[0] for point in find_entry_points(case)}
    declared = requirements(case) | {normalise(case.distribution)}
    reachable = set(declared)
    for name in (*declared, CORE):
        reachable |= _needs(name)
    promised = {r.module for spec in _specs(case) for r in spec.requires}
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


def _check_safe_calls(case: PackageCase) -> None:
    for path in source_files(case):
        for line, name, reason in unsafe_calls(path):
            require(False, f"{path.name}:{line} calls {name}, which {reason}")


@functools.lru_cache(maxsize=4)
def _owners(path: tuple[str, ...]) -> Mapping[str, list[str]]:
    """Distributions by the top-level packages that they hold; reading them takes a second for every
    path.
    """
    return packages_distributions()


@functools.cache
def _needs(name: str) -> frozenset[str]:
    """Normalised names of all that an installed distribution requires without extras, directly or
    not.
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


def _specs(case: PackageCase) -> Iterator[Spec | DriverSpec]:
    """The descriptors of a distribution or plugin that can be read here, those of drivers
    included.
    """
    for offer in _installed().all_offers:
        if normalise(offer.distribution) == normalise(case.distribution) and case.plugin in (
            "",
            offer.plugin,
        ):
            yield offer.spec
            if isinstance(offer.spec, RobotSpec):
                yield from offer.spec.drivers


def _installed() -> Registry:
    """The plugins that are installed here."""
    return _discovered(tuple(sys.path))


@functools.lru_cache(maxsize=4)
def _discovered(path: tuple[str, ...]) -> Registry:
    """The plugins on an import path, for which most rules ask."""
    return discover()


_SOURCE = "docs/writing-a-plugin.md"

RULES: tuple[Rule[PackageCase], ...] = (
    Rule(
        id="package/entry-point",
        text="An entry point of the group `roboneuron` names a module that the package holds.",
        source="roboneuron.plugins.hookspecs",
        check=_check_entry_point,
    ),
    Rule(
        id="package/hooks-usable",
        text="Its hooks are spelled, decorated and answered as the hook page says.",
        source="roboneuron.plugins.hookspecs",
        check=_check_hooks,
    ),
    Rule(
        id="package/plugin-module-light",
        text="Importing the plugin module imports nothing but the standard library, pluggy and "
        "the package itself.",
        source="roboneuron.plugins",
        check=_check_light,
    ),
    Rule(
        id="package/plugin-module-pure",
        text="Importing the plugin module prints, writes, starts, connects and computes nothing.",
        source="roboneuron.plugins",
        check=_check_pure,
    ),
    Rule(
        id="package/typed", text="The package holds py.typed.", source=_SOURCE, check=_check_typed
    ),
    Rule(
        id="package/readme", text="The metadata hold a README.", source=_SOURCE, check=_check_readme
    ),
    Rule(
        id="package/summary",
        text="The metadata hold a summary.",
        source=_SOURCE,
        check=_check_summary,
    ),
    Rule(
        id="package/licence",
        text="The metadata name a licence and the distribution holds its text.",
        source=_SOURCE,
        check=_check_licence,
    ),
    Rule(
        id="package/requires-python",
        text="The metadata say from which Python version on it runs.",
        source=_SOURCE,
        check=_check_python,
    ),
    Rule(
        id="package/requires-core",
        text=f"It declares that it needs {CORE}, with a lower and an upper bound.",
        source=_SOURCE,
        check=_check_core,
    ),
    Rule(
        id="package/import-direction",
        text="Of the core it imports what `roboneuron` lists; with features or commands, "
        "`roboneuron.feature`, `roboneuron.node` or `roboneuron.command` too.",
        source=_SOURCE,
        check=_check_direction,
    ),
    Rule(
        id="package/siblings-declared",
        text="It imports other plugins only when it declares to need them.",
        source=_SOURCE,
        check=_check_siblings,
    ),
    Rule(
        id="package/kit-in-cases-only",
        text=f"Only modules that a descriptor's `case` or `rules` names import {KIT}, unless it "
        "depends on it.",
        source=_SOURCE,
        check=_check_kit,
    ),
    Rule(
        id="package/imports-declared",
        text="What it imports comes with a distribution that it declares, or with a descriptor's "
        "`requires`.",
        source=_SOURCE,
        check=_check_imports_declared,
    ),
    Rule(
        id="package/no-unsafe-calls",
        text="It reads no pickles, runs no text as code and no shell.",
        source=_SOURCE,
        check=_check_safe_calls,
    ),
)
"""Rules of packages."""

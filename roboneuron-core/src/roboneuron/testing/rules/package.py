"""Rules of packages: what a user of pip, a type checker and the registry may rely on."""

from __future__ import annotations

from importlib.metadata import distributions

from roboneuron.plugins.markers import PROJECT
from roboneuron.testing.cases import PackageCase
from roboneuron.testing.distribution import (
    find_distribution,
    find_entry_points,
    find_package_directory,
    header,
    imported_modules,
    normalise,
    probe,
    requirements,
    source_files,
)
from roboneuron.testing.rule import Rule, require

HEAVY = ("numpy", "torch", "rclpy", "mcp", "pydantic")
"""What listing plugins must not import."""
CORE_ROOMS = ("server", "supervisor", "modules", "cli")
"""Packages of the core that no plugin may import."""
CORE = "roboneuron-core"
"""Distribution that every plugin needs."""


def _check_entry_point(case: PackageCase) -> None:
    for point in find_entry_points(case):
        directory = find_package_directory(case, point.module)
        inner = point.module.split(".")[1:]
        place = directory.joinpath(*inner)
        exists = place.with_suffix(".py").is_file() or (place / "__init__.py").is_file()
        require(exists, f"the entry point names {point.module!r}, which {directory.name} does not hold")
        require(not point.attr, f"the entry point is {point.value!r}, expected a module without attribute")


def _check_hooks(case: PackageCase) -> None:
    for point in find_entry_points(case):
        problem = probe(case, point.module).problem
        require(not problem, f"{point.module}: {problem}")


def _check_light(case: PackageCase) -> None:
    for point in find_entry_points(case):
        heavy = [name for name in HEAVY if name in probe(case, point.module).loaded]
        require(not heavy, f"importing {point.module} imports {', '.join(heavy)}")


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
    require(bool(header(case, "License-File")), "the distribution holds no licence file")


def _check_python(case: PackageCase) -> None:
    require(bool(header(case, "Requires-Python")), "the metadata hold no Requires-Python")


def _check_core(case: PackageCase) -> None:
    require(CORE in requirements(case), f"the distribution does not require {CORE}")


def _check_direction(case: PackageCase) -> None:
    forbidden = tuple(f"{PROJECT}.{room}" for room in CORE_ROOMS)
    for path in source_files(case):
        for name, line in imported_modules(path):
            inside = any(name == room or name.startswith(f"{room}.") for room in forbidden)
            require(not inside, f"{path.name}:{line} imports {name}; plugins import contract, errors, plugins, testing")


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
            require(owner is None or owner in declared, f"{path.name}:{line} imports {name} of {owner}, not declared")


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
        text=f"Importing the plugin module imports none of {', '.join(HEAVY)}.",
        source="roboneuron.plugins",
        check=_check_light,
    ),
    Rule(id="package/typed", text="The package holds py.typed.", source=_SOURCE, check=_check_typed),
    Rule(id="package/readme", text="The metadata hold a README.", source=_SOURCE, check=_check_readme),
    Rule(id="package/summary", text="The metadata hold a summary.", source=_SOURCE, check=_check_summary),
    Rule(
        id="package/licence",
        text="The metadata name a licence and the distribution holds its text.",
        source=_SOURCE,
        check=_check_licence,
    ),
    Rule(
        id="package/requires-python",
        text="The metadata say which Python versions it runs on.",
        source=_SOURCE,
        check=_check_python,
    ),
    Rule(id="package/requires-core", text=f"It declares that it needs {CORE}.", source=_SOURCE, check=_check_core),
    Rule(
        id="package/import-direction",
        text="It imports neither server, supervisor, modules nor cli of the core.",
        source=_SOURCE,
        check=_check_direction,
    ),
    Rule(
        id="package/siblings-declared",
        text="It imports other plugins only when it declares to need them.",
        source=_SOURCE,
        check=_check_siblings,
    ),
)
"""Rules of packages."""

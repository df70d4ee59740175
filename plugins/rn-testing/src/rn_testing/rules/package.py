"""Rules of packages: metadata and files for pip, type checkers and the registry. `package_imports`
has those on imports.
"""

from __future__ import annotations

import sys
from collections.abc import Collection

from rn_testing.cases import PackageCase
from rn_testing.distribution import (
    PROJECT,
    find_distribution,
    find_entry_points,
    find_package,
    find_package_directory,
    header,
    normalise,
    probe,
    requirements,
    source_files,
)
from rn_testing.rule import Rule, require
from rn_testing.rules import installed
from rn_testing.unsafe_calls import unsafe_calls

CORE = "roboneuron-core"
"""Distribution that every plugin requires."""


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
    # such as a suite's descriptor
    brought = {spec.__module__.rpartition(".")[0] for spec in installed.plugins().kinds.values()}
    for point in find_entry_points(case):
        packages = brought | {find_package(case, point.module)}
        heavy = {_foreign(name, packages) for name in probe(case, point.module).loaded} - {""}
        require(not heavy, f"importing {point.module} imports {', '.join(sorted(heavy))}")


def _foreign(module: str, packages: Collection[str]) -> str:
    """Name of a package that a plugin module should not load: a foreign package, or another plugin;
    empty if allowed.

    Args:
        module: name of a loaded module.
        packages: allowed packages, besides the core, pluggy and the standard library.
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


def _check_safe_calls(case: PackageCase) -> None:
    for path in source_files(case):
        for line, name, reason in unsafe_calls(path):
            require(False, f"{path.name}:{line} calls {name}, which {reason}")


PAGE = "docs/writing-a-plugin.md"

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
    Rule(id="package/typed", text="The package holds py.typed.", source=PAGE, check=_check_typed),
    Rule(id="package/readme", text="The metadata hold a README.", source=PAGE, check=_check_readme),
    Rule(
        id="package/summary",
        text="The metadata hold a summary.",
        source=PAGE,
        check=_check_summary,
    ),
    Rule(
        id="package/licence",
        text="The metadata name a licence and the distribution holds its text.",
        source=PAGE,
        check=_check_licence,
    ),
    Rule(
        id="package/requires-python",
        text="The metadata say from which Python version on it runs.",
        source=PAGE,
        check=_check_python,
    ),
    Rule(
        id="package/requires-core",
        text=f"It declares that it needs {CORE}, with a lower and an upper bound.",
        source=PAGE,
        check=_check_core,
    ),
    Rule(
        id="package/no-unsafe-calls",
        text="It loads no pickles, and runs no text as code and no shell.",
        source=PAGE,
        check=_check_safe_calls,
    ),
)
"""Rules of packages."""

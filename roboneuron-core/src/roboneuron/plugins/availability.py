"""Check for missing required modules, without importing any of them."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Iterable
from importlib.resources import files
from importlib.util import find_spec

from roboneuron.plugins.specs import Requirement


def is_importable(module: str) -> bool:
    """True if the top-level `module` could be imported; the module is searched for, never executed.

    Args:
        module: without a dot, because searching for a submodule would import its package.
    """
    # None marks a module that must not be imported, and has no `__spec__` to look up
    if module in sys.modules:
        return sys.modules[module] is not None
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def present(requirement: Requirement) -> tuple[str, ...]:
    """Names among its module and alternatives that can be found, in their order."""
    return tuple(
        module
        for module in (requirement.module, *requirement.alternatives)
        if is_importable(module)
    )


def missing(requirements: Iterable[Requirement]) -> tuple[Requirement, ...]:
    """Requirements without a module or alternative that can be found, in their order."""
    return tuple(r for r in requirements if not present(r))


def explain(absent: Iterable[Requirement]) -> str:
    """Explain in one sentence which modules are absent and which commands provide them.

    Args:
        absent: at least one, see `missing`; a command that provides several is named once.
    """
    parts = tuple(absent)
    modules = ", ".join(
        " or ".join(f"'{name}'" for name in (r.module, *r.alternatives)) for r in parts
    )
    return (
        f"Needs {modules}, not installed; run: "
        f"{'; '.join(dict.fromkeys(part.install for part in parts))}"
    )


WHOLE = "roboneuron"
"""The distribution that requires everything named in the embedded default configuration;
requirements.txt installs it.
"""


def package_of(kind: str, name: str) -> str | None:
    """The project's own package that offers `name`, with the necessary extra; None if unknown."""
    package = _table().get(kind, {}).get(name)
    return package if isinstance(package, str) else None


def new_name(name: str) -> str | None:
    """Present name of an offer that was renamed from `name`; None for any other name."""
    return _table()["renamed"].get(name)


def known_names(kind: str = "") -> dict[str, str]:
    """Package by name of an offer, of any kind or of one; "switch": features with a flag of
    `serve`.
    """
    kinds = {kind} if kind else _table().keys() - {"needs", "switch", "renamed"}
    return {name: package for of in sorted(kinds) for name, package in _table()[of].items()}


def install_command(*packages: str) -> str:
    """The command that installs packages of the project and their dependencies from its source
    folder; without arguments, those named in the embedded default configuration.
    """
    packages = packages or (WHOLE,)
    needs = _table()["needs"]
    wanted = dict.fromkeys(packages)
    for package in packages:
        wanted |= dict.fromkeys(needs.get(package.partition("[")[0], ()))
    common = {WHOLE, *needs[WHOLE]}
    words = ["-r requirements.txt"] if common & set(wanted) else []
    words += [
        f'"./plugins/{name}"' if "[" in name else f"./plugins/{name}"
        for name in wanted
        if name not in common
    ]
    return f"pip install {' '.join(words)} (in RoboNeuron's source folder)"


def _table() -> dict[str, dict[str, str]]:
    """Read data/packages.toml on demand: most commands never need it."""
    return tomllib.loads(
        files("roboneuron").joinpath("data/packages.toml").read_text(encoding="utf-8")
    )

"""Which required modules are absent, found out without importing any of them."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Iterable
from importlib.resources import files
from importlib.util import find_spec

from roboneuron.plugins.specs import Requirement


def is_importable(module: str) -> bool:
    """Whether the top-level `module` could be imported; it is looked up, never executed.

    Args:
        module: without a dot: to look up a submodule would import its package.
    """
    # None marks a module that must not be imported, and has no `__spec__` to look up
    if module in sys.modules:
        return sys.modules[module] is not None
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def present(requirement: Requirement) -> tuple[str, ...]:
    """Which of its module and alternatives can be found, in their order."""
    return tuple(
        module
        for module in (requirement.module, *requirement.alternatives)
        if is_importable(module)
    )


def missing(requirements: Iterable[Requirement]) -> tuple[Requirement, ...]:
    """Those of `requirements` for which neither the module nor an alternative can be found, in
    their order.
    """
    return tuple(r for r in requirements if not present(r))


def explain(absent: Iterable[Requirement]) -> str:
    """One sentence that names the absent modules and the commands that provide them.

    Args:
        absent: at least one, see `missing`; commands that provide several of them are named once.
    """
    parts = tuple(absent)
    modules = ", ".join(
        " or ".join(f"'{name}'" for name in (r.module, *r.alternatives)) for r in parts
    )
    commands = "; ".join(dict.fromkeys(r.install for r in parts))
    return f"Needs {modules}, not installed; run: {commands}"


WHOLE = "roboneuron"
"""The distribution that needs all of what the embedded default configuration names;
requirements.txt installs it.
"""


def package_of(kind: str, name: str) -> str | None:
    """The project's own package that offers `name`, with the extra that it needs; None when no such
    is known.
    """
    package = _table().get(kind, {}).get(name)
    return package if isinstance(package, str) else None


def new_name(name: str) -> str | None:
    """What an offer is called now that was called `name` before; None for any other name."""
    return _table()["renamed"].get(name)


def known_names(kind: str = "") -> dict[str, str]:
    """Package by name of an offer, of any kind or of one; "switch": features that `serve` has a
    flag for.
    """
    kinds = {kind} if kind else _table().keys() - {"needs", "switch", "renamed"}
    return {name: package for of in sorted(kinds) for name, package in _table()[of].items()}


def install_command(*packages: str) -> str:
    """The command that installs packages of the project, with those that they need, from its source
    folder; without arguments, what the embedded default configuration names.
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
    """data/packages.toml, read when it is needed: most commands never ask for it."""
    return tomllib.loads(
        files("roboneuron").joinpath("data/packages.toml").read_text(encoding="utf-8")
    )

"""Check for missing required modules, without importing any of them."""

from __future__ import annotations

import json
import re
import shlex
import sys
import tomllib
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, distribution
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

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
    return f"Needs {modules}, not installed; run: {install_of(parts)}"


def install_of(absent: Iterable[Requirement]) -> str:
    """The commands that provide absent modules, each once, as this installation can run them."""
    return "; ".join(dict.fromkeys(_fitted(part.install) for part in absent))


def _fitted(command: str) -> str:
    """A command that names packages by their source folder; of an installation from wheels, which
    may have no such folder, the one that names the wheels.
    """
    packages = _FOLDER.findall(command)
    if not packages or is_from_source():
        return command
    return install_command(*packages)


def is_from_source() -> bool:
    """True if this installation was made from a source folder, not from wheels. Source: PEP 610."""
    return "dir_info" in _direct_url()


def _direct_url() -> dict[str, Any]:
    try:
        text = distribution(CORE).read_text("direct_url.json")
    # without metadata, the code runs from its source folder
    except PackageNotFoundError:
        return {"dir_info": {}}
    # pip writes none for a wheel that it found itself, in a folder or on an index
    found: dict[str, Any] = json.loads(text) if text else {}
    return found


CORE = "roboneuron-core"
_FOLDER = re.compile(r"\./plugins/([a-z0-9-]+(?:\[[a-z0-9,-]+\])?)")
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
    """The command that installs packages of the project and their dependencies, from its source
    folder or from wheels as this installation was made; without arguments, those named in the
    embedded default configuration.
    """
    packages = packages or (WHOLE,)
    if not is_from_source():
        return _from_wheels(packages)
    needs = _table()["needs"]
    wanted = dict.fromkeys(packages)
    for package in packages:
        wanted |= dict.fromkeys(needs.get(package.partition("[")[0], ()))
    common = {WHOLE, *needs[WHOLE]}
    words = ["-r requirements.txt"] if common & set(wanted) else []
    for name in wanted:
        if name not in common:
            folder = f"./{name}" if name == CORE else f"./plugins/{name}"
            words.append(f'"{folder}"' if "[" in name else folder)
    return f"pip install {' '.join(words)} (in RoboNeuron's source folder)"


def _from_wheels(packages: Iterable[str]) -> str:
    file = Path(unquote(urlsplit(_direct_url().get("url", "")).path))
    words = " ".join(f'"{name}"' if "[" in name else name for name in packages)
    # the packages are on no index: without the folder, pip would take what others put there
    if file.suffix == ".whl" and file.parent.is_dir():
        return f"pip install --find-links {shlex.quote(str(file.parent))} {words}"
    return f"pip install --find-links WHEELS {words} (WHEELS: the folder of RoboNeuron's wheels)"


def _table() -> dict[str, dict[str, str]]:
    """Read data/packages.toml on demand: most commands never need it."""
    return tomllib.loads(
        files("roboneuron").joinpath("data/packages.toml").read_text(encoding="utf-8")
    )

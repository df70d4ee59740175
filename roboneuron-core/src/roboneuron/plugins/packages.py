"""Hints that name the package to install; what the project's own packages offer stands in `data/packages.toml`."""

from __future__ import annotations

import tomllib
from importlib.resources import files

START = ("rn-robot-fr3", "rn-controller-urdf", "rn-backend-servo")
"""What the embedded default configuration needs."""


def package_of(kind: str, name: str) -> str | None:
    """The project's own package that offers `name`, with the extra that it needs; None when no such is known."""
    package = _table().get(kind, {}).get(name)
    return package if isinstance(package, str) else None


def known_names() -> dict[str, str]:
    """Package by name of an offer, of any kind."""
    return {name: package for kind, table in _table().items() if kind != "needs" for name, package in table.items()}


def install_command(*packages: str) -> str:
    """The command that installs packages of the project, with those that they need, from its source folder."""
    needs = _table()["needs"]
    wanted = dict.fromkeys(packages)
    for package in packages:
        wanted |= dict.fromkeys(needs.get(package.partition("[")[0], ()))
    words = [f'"./plugins/{package}"' if "[" in package else f"./plugins/{package}" for package in wanted]
    return f"pip install {' '.join(words)} (in RoboNeuron's source folder)"


def _table() -> dict[str, dict[str, str]]:
    return tomllib.loads(files("roboneuron").joinpath("data/packages.toml").read_text(encoding="utf-8"))

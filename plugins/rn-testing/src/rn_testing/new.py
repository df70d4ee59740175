"""The command `roboneuron new`: creates a plugin package of a kind from templates."""

from __future__ import annotations

import keyword
import re
from argparse import ArgumentParser, Namespace
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from string import Template

from roboneuron import ConfigurationError
from roboneuron.command import PLUGIN_KINDS, descriptor

BROUGHT = {
    "monitor": "rn-standard",
    "suite": "rn-eval",
    "teleoperator": "rn-standard",
}
"""Kinds whose hook is provided by another package, with that package."""
NEW_KINDS = sorted([*PLUGIN_KINDS, *BROUGHT])
"""Kinds with templates."""
PREFIXES = {kind: "accel" if kind == "acceleration" else kind for kind in NEW_KINDS}
"""Middle part of the distribution's name: rn-<prefix>-<name>."""


class New:
    """Write a plugin package of one of the kinds; it passes its own contract tests as written."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron new`."""
        parser.add_argument(
            "kind", choices=NEW_KINDS, metavar="KIND", help=f"one of {', '.join(NEW_KINDS)}"
        )
        parser.add_argument(
            "name", metavar="NAME", help="name by which users select it, such as my-policy"
        )
        parser.add_argument(
            "--directory", type=Path, metavar="DIR", help="directory to create (./rn-KIND-NAME)"
        )

    def run(self, arguments: Namespace) -> int:
        """Write the package and print the next steps."""
        distribution = f"rn-{PREFIXES[arguments.kind]}-{arguments.name}"
        directory = arguments.directory or Path(distribution)
        written = write_package(arguments.kind, arguments.name, directory)
        print(f"Wrote {len(written)} files of {distribution} to {directory}/. Next:\n")
        print(
            f"  cd {directory}\n  pip install -e '.[testing]'\n  pytest\n  roboneuron plugins "
            f"check {arguments.name}"
        )
        return 0


def write_package(kind: str, name: str, directory: Path) -> list[Path]:
    """Write a plugin package and return the paths of its files.

    Raises:
        ConfigurationError: the name is malformed, or the directory is not empty.
    """
    package = f"rn_{PREFIXES[kind]}_{name}".replace("-", "_")
    class_name = "".join(part.capitalize() for part in name.split("-"))
    if (
        not descriptor.NAME_PATTERN.fullmatch(name)
        or not class_name.isidentifier()
        or keyword.iskeyword(class_name)
    ):
        suggestion = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-0123456789")
        raise ConfigurationError(
            f"The name {name!r} is malformed, expected lower-case letters, digits and single "
            "hyphens, a letter first"
            f"{f'; for instance {suggestion!r}' if suggestion else ''}."
        )
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise ConfigurationError(
            f"{directory} exists and is not empty.", hint="Choose another one with --directory."
        )
    words = {
        "kind": kind,
        "name": name,
        "distribution": f"rn-{PREFIXES[kind]}-{name}",
        "package": package,
    }
    words |= {"cls": class_name, "tool": name.replace("-", "_")}
    needed = ["roboneuron-core", *([BROUGHT[kind]] if kind in BROUGHT else [])]
    words["dependencies"] = ", ".join(f'"{other}>=0.1,<0.2"' for other in needed)
    templates = files("rn_testing") / "templates"
    written = [_write(directory / "src" / package / "py.typed", "")]
    for folder in ("common", kind):
        for source in sorted((templates / folder).iterdir(), key=lambda s: s.name):
            written.append(_write(directory / _place(source.name, package), _fill(source, words)))
    return written


def _place(template: str, package: str) -> Path:
    """Destination of a template: metadata at the top, tests in `tests`, everything else in the
    package.
    """
    name = template.removesuffix(".tmpl")
    if name in ("pyproject.toml", "README.md", "LICENSE"):
        return Path(name)
    if name.startswith("test_"):
        return Path("tests") / name.replace("test_contract", f"test_{package}_keeps_its_contract")
    return Path("src") / package / name


def _fill(source: Traversable, words: dict[str, str]) -> str:
    text = source.read_text(encoding="utf-8")
    return Template(text).substitute(words) if source.name.endswith(".tmpl") else text


def _write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path

"""Names of ROS interfaces: format, installed ones, suggestions for unknown ones."""

from __future__ import annotations

import difflib
import importlib.util
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from roboneuron.direct_path.interface_class import UnusableTypeError
from roboneuron.errors import ConfigurationError

KINDS = ("msg", "srv", "action")
"""Kinds of interface, in the order in which a name without a kind is looked up."""

_PACKAGE = re.compile(r"[a-z][a-z0-9_]{0,99}\Z")
_NAME = re.compile(r"[A-Z][A-Za-z0-9]{0,99}\Z")
_INDEX = Path("share", "ament_index", "resource_index", "rosidl_interfaces")


@dataclass(frozen=True, order=True, slots=True)
class InterfaceName:
    """The full name of an interface, written "package/kind/Name"."""

    package: str
    kind: str
    name: str

    def __str__(self) -> str:
        return f"{self.package}/{self.kind}/{self.name}"


def interface_prefixes(environ: Mapping[str, str] | None = None) -> tuple[Path, ...]:
    """Installation prefixes that may contain interfaces: AMENT_PREFIX_PATH first, then `sys.prefix`
    (the pip wheels).

    Nothing is written to the environment. Only existing folders are returned, each once.
    """
    variables = os.environ if environ is None else environ
    written = [
        Path(entry) for entry in variables.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if entry
    ]
    return tuple(
        dict.fromkeys(prefix for prefix in [*written, Path(sys.prefix)] if prefix.is_dir())
    )


def list_interfaces(
    package: str | None = None, *, prefixes: Sequence[Path] | None = None
) -> tuple[InterfaceName, ...]:
    """Return the installed interfaces, sorted, whose package can be imported by this interpreter.

    Args:
        package: only this package's; empty for an unknown package.
        prefixes: prefixes to search; `interface_prefixes()` by default.
    """
    found: set[InterfaceName] = set()
    for prefix in interface_prefixes() if prefixes is None else prefixes:
        folder = prefix / _INDEX
        if not folder.is_dir():
            continue
        for entry in folder.iterdir():
            if (package is None or entry.name == package) and _PACKAGE.match(entry.name):
                found.update(_read_entry(entry))
    importable = {name: bool(_package_folders(name)) for name in {f.package for f in found}}
    return tuple(sorted(f for f in found if importable[f.package]))


def _read_entry(entry: Path) -> list[InterfaceName]:
    names = []
    for line in entry.read_text(encoding="utf-8").splitlines():
        kind, _, file = line.strip().partition("/")
        name = file.rpartition(".")[0]
        if kind in KINDS and _NAME.match(name):
            names.append(InterfaceName(entry.name, kind, name))
    return names


def _package_folders(package: str) -> tuple[Path, ...]:
    """Folders of an importable package, found without importing it."""
    spec = importlib.util.find_spec(package)
    return (
        tuple(Path(p) for p in (spec.submodule_search_locations or ())) if spec is not None else ()
    )


def is_interface_package(package: str, kind: str) -> bool:
    """True if `package` is importable and has a subpackage `kind`; nothing is imported."""
    if not _PACKAGE.match(package) or kind not in KINDS:
        return False
    return any((folder / kind / "__init__.py").is_file() for folder in _package_folders(package))


def parse_interface_name(text: str) -> tuple[InterfaceName, ...]:
    """Return the possible names of `text`: one for "package/kind/Name", one per kind for
    "package/Name".

    Raises:
        ConfigurationError: `text` is not a valid interface name.
    """
    parts = text.split("/") if isinstance(text, str) else []
    kinds = (parts.pop(1),) if len(parts) == 3 else KINDS
    if (
        len(parts) != 2
        or not set(kinds) <= set(KINDS)
        or not (_PACKAGE.match(parts[0]) and _NAME.match(parts[1]))
    ):
        raise ConfigurationError(
            f"{str(text)[:120]!r} is not the name of an interface.",
            hint="Write it as package/msg/Name, package/srv/Name or package/action/Name.",
        )
    return tuple(InterfaceName(parts[0], kind, parts[1]) for kind in kinds)


def unknown_interface(text: str, known: Sequence[InterfaceName]) -> ConfigurationError:
    """Create the error for an interface that is not installed, with the nearest names as a hint."""
    names = [str(name) for name in known]
    short = {f"{n.package}/{n.name}": str(n) for n in known}
    near = difflib.get_close_matches(text, names, n=3, cutoff=0.6)
    near += [short[s] for s in difflib.get_close_matches(text, list(short), n=3, cutoff=0.6)]
    last = text.rpartition("/")[2]
    near += [str(n) for n in known if n.name == last]
    unique = list(dict.fromkeys(near))[:3]
    hint = (
        f"Did you mean {' or '.join(unique)}?"
        if unique
        else "`list_interfaces` shows the installed ones."
    )
    return UnusableTypeError(f"No installed interface is called {text!r}.", hint=hint)

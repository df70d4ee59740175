"""Definitions in the ament prefixes of this machine's processes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from rn_interfaces.definitions import outline
from rn_interfaces.described import read_hashes
from rn_interfaces.finder import PREFIXES
from rn_interfaces.found import FoundDefinition
from rn_interfaces.store import Name
from roboneuron import ConfigurationError

PROCESSES = Path("/proc")


def prefixes_of_processes(processes: Path = PROCESSES) -> list[Path]:
    """Ament prefixes in the environments of all accessible processes."""
    found: dict[Path, None] = {}
    for path in processes.glob("[0-9]*/environ"):
        try:
            variables = path.read_bytes().split(b"\0")
        except OSError:  # of another user, or just ended
            continue
        for variable in variables:
            name, _, value = os.fsdecode(variable).partition("=")
            if name == PREFIXES:
                found.update(dict.fromkeys(Path(one) for one in value.split(os.pathsep) if one))
    return list(found)


def definition_of(
    name: Name, announced: Mapping[str, str], prefixes: Sequence[Path]
) -> dict[Name, FoundDefinition]:
    """Definition of a service or action and of its dependencies, from the first prefix whose
    description has all announced hashes; empty if there is none.

    Args:
        name: name of the service or action.
        announced: RIHS01 by full name of a part.
        prefixes: prefixes in the order of the search.
    """
    for prefix in prefixes:
        try:
            path = (prefix / "share" / name.file).with_suffix(".json")
            hashes = read_hashes(path)
            if announced.items() <= hashes.items():
                return dict(_texts(prefix, name, announced))
        except (OSError, ValueError, ConfigurationError):
            continue  # it has none, or a damaged one
    return {}


def _texts(
    prefix: Path, name: Name, announced: Mapping[str, str]
) -> Iterator[tuple[Name, FoundDefinition]]:
    waiting = [name]
    done: set[Name] = set()
    while waiting:
        one = waiting.pop()
        path = prefix / "share" / one.file
        if one in done or (one != name and not path.is_file()):  # others are looked up as usual
            continue
        done.add(one)
        text = path.read_text(encoding="utf-8")
        yield one, FoundDefinition(text, str(path), announced if one == name else {})
        waiting += outline(one, text).used

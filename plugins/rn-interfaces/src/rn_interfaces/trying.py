"""Trial of generated classes: imported, filled with their defaults, encoded and decoded.

    python -P -m rn_interfaces.trying PREFIX < NAMES

It runs as a program of its own, so that a class that never ends, or ends Python, is found.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from rn_interfaces.asking import ask_each
from rn_interfaces.cache import Cache
from rn_interfaces.store import DefinitionStore, Name, parse_name

_PARTS = {"msg": (), "srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}


def failures(store: DefinitionStore, names: Sequence[Name]) -> dict[Name, str]:
    """Generate the classes of a store's interfaces and try them; return the reasons of those that
    cannot be used.
    """
    return Cache(store).make(names) or ask_each(__name__, store.prefix, sorted(names))


def attempt(name: Name) -> str:
    """Use an interface's classes; return the reason why it fails, empty if it does not."""
    try:
        cls = getattr(import_module(f"{name.package}.{name.kind}"), name.word)
        for part in _parts(cls, name.kind):
            _use(part)
    except Exception as error:  # of generated code: whatever a name or a default causes in it
        return f"{type(error).__name__}: {' '.join(str(error).split())}"[:200]
    return ""


def _parts(cls: Any, kind: str) -> Iterator[Any]:
    yield from (getattr(cls, part) for part in _PARTS[kind]) if kind != "msg" else (cls,)


def _use(cls: Any) -> None:
    from rn_interfaces.codec import codec
    from rn_interfaces.program import program

    message = cls()
    for field in cls.get_fields_and_field_types():
        setattr(message, field, getattr(message, field))
    both = codec(cls)
    program(cls)
    data = both.encode(message)
    repr(both.decode(data if isinstance(data, bytes) else b"".join([*data])))


def main() -> None:
    """Try the interfaces of the store given as the argument, whose full names are the lines of
    stdin, and write [name, reason] as a line of JSON for each.
    """
    from rn_interfaces.finder import install

    install(DefinitionStore(Path(sys.argv[1])))
    answers, sys.stdout = sys.stdout, sys.stderr
    for line in sys.stdin.read().split():
        answers.write(json.dumps([line, attempt(parse_name(line))]) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()

"""Definitions in MCAP files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rn_interfaces.found import FoundDefinition, FoundDefinitions, Refusal
from rn_interfaces.store import MOST_INTERFACES, Name, parse_name
from roboneuron import ConfigurationError

if TYPE_CHECKING:
    from mcap.records import McapRecord

_RULE = re.compile(r"^={80}\n", re.MULTILINE)
ENCODING = "ros2msg"
"""Encoding of schemas that are learnt."""


def of_mcap(path: Path) -> FoundDefinitions:
    """Return the definitions in a recording, and the schemas that give none.

    Raises
    ------
    ConfigurationError
        It is no MCAP file. One that is cut off gives what it has.
    OSError
        It cannot be read.
    """
    from mcap.records import Schema  # heavy

    found = FoundDefinitions()
    records = 0
    try:
        for record in _records(path):
            records += 1
            if isinstance(record, Schema):
                _take(found, record.name, record.encoding, record.data, path)
    except _DamageError as error:
        if not records:
            raise ConfigurationError(
                f"{path} is no MCAP file: {error}.",
                hint="Expected is a file of `ros2 bag record -s mcap`, or one of RoboNeuron.",
            ) from error
        found.refused[str(path)] = Refusal(
            f"The file is cut off or damaged: {error}.",
            "Types after that place are not learnt; repair it with `mcap recover`.",
        )
    return found


class _DamageError(Exception):
    """Bytes that are no records."""


def _records(path: Path) -> Iterator[McapRecord]:
    from mcap.stream_reader import StreamReader  # heavy

    with path.open("rb") as file:
        size = path.stat().st_size  # no record is longer, whatever its length says
        records = StreamReader(file, validate_crcs=True, record_size_limit=size).records
        while True:
            try:
                record = next(records, None)
            except Exception as error:  # of mcap and its decompressors, without a common base
                what = " ".join(str(error).split())[:200] or type(error).__name__
                raise _DamageError(what) from error
            if record is None:
                return
            yield record


def _take(found: FoundDefinitions, name: str, encoding: str, data: bytes, path: Path) -> None:
    key = repr(name[:120])[1:-1]
    if encoding != ENCODING:
        found.refused.setdefault(
            key,
            Refusal(
                f"Its schema has the encoding {encoding[:40]!r}, which is not learnt.",
                "Learn the type from a folder with its .msg file.",
                str(path),
            ),
        )
        return
    try:
        for one, text in _parts(name, data.decode()):
            found.add(one, FoundDefinition(text, str(path)))
    except UnicodeDecodeError:
        found.refused[key] = Refusal("Its schema is not UTF-8.", "", str(path))
    except ConfigurationError as error:
        found.refused[key] = Refusal(error.message, error.hint, str(path))
    if len(found.texts) > MOST_INTERFACES:
        raise ConfigurationError(f"{path} has more than {MOST_INTERFACES} interfaces.")


def _parts(name: str, data: str) -> Iterator[tuple[Name, str]]:
    """The definition, and those of all types that it uses."""
    first, *others = _RULE.split(data)
    yield _full(name), first
    for part in others:
        head, _, text = part.partition("\n")
        yield _full(head.removeprefix("MSG: ").strip()), text


def _full(name: str) -> Name:
    """Parse a name with or without its kind, `weld_msgs/msg/Seam` or `weld_msgs/Seam`."""
    package, _, word = name.rpartition("/")
    return parse_name(f"{package.removesuffix('/msg')}/msg/{word}" if package else name)

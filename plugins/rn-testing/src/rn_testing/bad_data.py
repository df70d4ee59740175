"""Seeded generator of invalid data for the tests of parsers: mutations of a valid document, and
values that decoders of JSON accept although later code does not expect them.
"""

from __future__ import annotations

import json
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

NASTY_TOKENS = (
    *("null", "true", "false", '""', "[]", "{}", "0", "-1", "1e999", "-1e999", "NaN", "Infinity"),
    *("1" * 400, "-" + "9" * 5000, "18446744073709551616", "1e-400", "0.1", '"\\ud800"'),
    *('"\\u202e"', '"\\u0000"', '"\\u001b[2J"', '["x"]', '{"a": 1, "a": 2}', "[[[[]]]]"),
    *(
        '"' + "x" * 70_000 + '"',
        "[" * 40 + "]" * 40,
        "[" * 60_000,
        '{"a":' * 5000,
        "[0" + ",0" * 9999,
    ),
    *("253402300800", "1e30", "-0.0", '[null, "a"]', '"NaN"', "[1, 2, 3, 4]"),
)
"""JSON that replaces one value, some of it invalid."""
NASTY_BYTES = (
    *(
        b"",
        b" ",
        b"\x00",
        b"\xff\xfe",
        b"\xc3",
        b"\xed\xa0\x80",
        b"{",
        b'{"',
        b"nul",
        b"\xef\xbb\xbf{}",
    ),
    *(b"[" * 60_000, b'{"a":' * 20_000, b"1" * 5000, b"NaN", b"-", b'"\\ud800"', b"[1e999]", b"[]"),
    *(b"{} {}", b"'a'", b"\x1b[2J", b"\n\n", b"{" + b'"a":0,' * 3000 + b'"b":0}'),
)
"""Whole documents."""
_PLACE = "\ue000place\ue000"


def bad_json(random: Random, valid: object) -> bytes:
    """A document made of a valid one: with another value somewhere, without a part, with bytes
    changed, or one of `NASTY_BYTES`. It may be valid by chance.
    """
    kind = random.randrange(8)
    if kind == 0:
        return random.choice(NASTY_BYTES)
    if kind <= 4:
        return with_token(random, valid, random.choice(NASTY_TOKENS)).encode()
    text = json.dumps(without_part(random, valid) if kind == 5 else valid).encode()
    return text if kind == 5 else with_bytes_changed(random, text)


def with_token(random: Random, valid: object, token: str) -> str:
    """The document as text, with this JSON in the place of a random value."""
    marked = _replaced(random, deepcopy(valid), _PLACE)
    return json.dumps(marked).replace(json.dumps(_PLACE), token)


def without_part(random: Random, valid: object) -> object:
    """The document without one random entry, or with one twice."""
    document = deepcopy(valid)
    parents = [one for one in _containers(document) if one]
    if not parents:
        return None
    parent = random.choice(parents)
    if isinstance(parent, dict):
        name = random.choice(list(parent))
        value = parent.pop(name)
        if random.random() < 0.3:
            parent[f"{name}?"] = value
    else:
        index = random.randrange(len(parent))
        if random.random() < 0.5:
            parent.pop(index)
        else:
            parent.insert(index, deepcopy(parent[index]))
    return document


def with_bytes_changed(random: Random, data: bytes) -> bytes:
    """The data cut, or with a few bytes changed, removed or inserted."""
    changed = bytearray(data)
    if random.random() < 0.3:
        return bytes(changed[: random.randrange(len(changed) + 1)])
    for _ in range(random.randint(1, 4)):
        at = random.randrange(len(changed) + 1)
        changed[at : at + random.randrange(3)] = random.randbytes(random.randrange(3))
    return bytes(changed)


def _replaced(random: Random, value: Any, by: object) -> Any:
    places: list[tuple[Any, Any]] = []
    for one in _containers(value):
        places += [(one, key) for key in (one if isinstance(one, dict) else range(len(one)))]
    if not places or random.random() < 0.03:
        return by
    parent, key = random.choice(places)
    parent[key] = by
    return value


def _containers(value: Any) -> list[Any]:
    if not isinstance(value, dict | list):
        return []
    inner = value.values() if isinstance(value, dict) else value
    return [value, *(deeper for one in inner for deeper in _containers(one))]


NOTHING: tuple[type[Exception], ...] = ()
ESCAPED = "ESCAPED"
"""Begins an outcome of `tried`."""


@dataclass(frozen=True)
class Parser:
    """One parser.

    Attributes:
        place: where the data come from.
        parse: called with each input; in a folder of its own.
        valid: document that is mutated; bytes are changed as they are.
        errors: what it may raise.
    """

    place: str
    parse: Callable[[Path, bytes], object]
    valid: Any
    errors: tuple[type[Exception], ...]


@contextmanager
def _quiet() -> Iterator[None]:
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)


def tried(parser: Parser, count: int, folder: Path, seed: int = 5) -> Counter[str]:
    """Outcomes of that many inputs: "taken", "refused", or `ESCAPED` with what escaped."""
    random, found = Random(seed), Counter[str]()
    with _quiet():
        for _ in range(count):
            if isinstance(parser.valid, bytes):
                data = with_bytes_changed(random, parser.valid)
            else:
                data = bad_json(random, parser.valid)
            try:
                parser.parse(folder, data)
            except parser.errors:
                found["refused"] += 1
            except Exception as error:
                told = f"{type(error).__name__}: {str(error)[:80]} of {data[:120]!r}"
                found[f"{ESCAPED} {told}"] += 1
            else:
                found["taken"] += 1
    return found


DAMAGES = (
    *("empty", "cut", "nested", "digits", "infinite", "half a pair", "another type", "not UTF-8"),
    *("a directory", "a pipe", "a link to itself", "huge"),
)
"""Kinds of damage to a state file; a link to itself cannot be read by any user, root included."""


def damage(path: Path, kind: str, valid: dict[str, object]) -> None:
    """Make a damaged file of one of `DAMAGES`."""
    text = json.dumps(valid)
    name = next(iter(valid))
    made = {
        "empty": "",
        "cut": text[:-3],
        "nested": "[" * 60_000,
        "digits": json.dumps({**valid, name: 0}).replace("0", "9" * 400, 1),
        "infinite": json.dumps({**valid, name: 0}).replace("0", "1e999", 1),
        "half a pair": json.dumps({**valid, name: chr(0xD800)}),
        "another type": json.dumps([valid]),
        "huge": json.dumps({**valid, "x": "y" * (1 << 23)}),
    }
    if kind == "a directory":
        path.mkdir()
    elif kind == "a pipe":
        os.mkfifo(path)
    elif kind == "a link to itself":
        path.symlink_to(path.name)
    else:
        path.write_bytes(b"\xff" + text.encode() if kind == "not UTF-8" else made[kind].encode())

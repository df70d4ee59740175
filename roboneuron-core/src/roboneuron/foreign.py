"""Data from outside: bounded decoding of JSON and files, and checked access to what was decoded.

Everything that a client, a page, a ROS node, a policy server, another machine or a file has written
passes here. Decoded values contain nothing that surprises later code: no number that is not finite
or has hundreds of digits, no text that cannot be encoded, no deep nesting, no key twice. All
functions raise `ForeignDataError` and nothing else, unless they say so.

`what` names the data in messages, such as "maintenance.json" or "an answer of the judge".
"""

from __future__ import annotations

import dataclasses
import errno
import json
import math
import os
import stat
import threading
import tomllib
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar, cast

from roboneuron.errors import ForeignDataError, shortened
from roboneuron.log_files import make_log_directory
from roboneuron.log_files import printable as printable
from roboneuron.log_files import quoted as quoted

MOST_BYTES = 1 << 20
"""Default size of a document [bytes]."""
MOST_FILE_BYTES = 1 << 16
"""Default size of a state file [bytes]."""
MOST_DEPTH = 32
"""Default depth of nested lists and objects; the deepest of our own formats has nine."""
MOST_TEXT = 16_384
"""Default limit of characters of a text taken with `text`."""
MOST_TYPE_LEVELS = 32
"""Most levels of ROS messages inside messages; those of ROS have seven."""
MOST_TYPE_FIELDS = 20_000
"""Most fields and list elements of a ROS message with all messages inside it; those of ROS have
500. Each is an object that a message creates, and a line of its description.
"""
MOST_DESCRIPTION_BYTES = 4 << 20
"""Maximum size of rosidl's JSON description of an interface [bytes]; those of ROS have 40 kB."""
_LEAST_INTEGER, _MOST_INTEGER = -(1 << 63), (1 << 64) - 1
"""Integers of 64 bits, signed or not; a float holds each of them without OverflowError."""
Document = dict[str, Any]


class _Model(Protocol):
    """A pydantic model; the core's light modules do not import pydantic."""

    @classmethod
    def model_validate(cls, obj: Any, /) -> Self: ...


class _JsonModel(Protocol):
    @classmethod
    def model_validate_json(cls, json_data: str, /) -> Self: ...


M = TypeVar("M", bound=_Model)
J = TypeVar("J", bound=_JsonModel)
D = TypeVar("D")


def decode_json(
    data: bytes | bytearray | str,
    what: str,
    *,
    most_bytes: int = MOST_BYTES,
    most_depth: int = MOST_DEPTH,
    has_constants: bool = False,
) -> Any:
    """Decode a JSON document.

    Args:
        data: UTF-8 or text.
        what: name of the data.
        most_bytes: limit of its size.
        most_depth: limit of nested lists and objects.
        has_constants: allow NaN, Infinity and -Infinity, for files that contain measurements.
    """
    if len(data) > most_bytes:
        raise ForeignDataError(f"{what} has {len(data)} bytes, at most {most_bytes} are read")
    try:
        text = data if isinstance(data, str) else data.decode("utf-8")
        value = json.loads(
            text,
            object_pairs_hook=_unique,
            parse_constant=None if has_constants else _refuse_constant,
        )
    except UnicodeDecodeError as error:
        raise ForeignDataError(f"{what} is not UTF-8 (byte {error.start})") from error
    except RecursionError as error:
        raise ForeignDataError(f"{what} is nested more than {most_depth} deep") from error
    # also integers with more digits than Python converts
    except ValueError as error:
        raise ForeignDataError(f"{what} is no valid JSON: {error}") from error
    check_value(value, what, most_depth=most_depth, has_constants=has_constants)
    return value


def _unique(pairs: list[tuple[str, object]]) -> Document:
    found = dict(pairs)
    if len(found) != len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {shortened(twice)} occurs twice in an object")
    return found


def _refuse_constant(name: str) -> object:
    raise ValueError(f"{name} is no number of JSON")


def check_value(
    value: object, what: str, *, most_depth: int = MOST_DEPTH, has_constants: bool = False
) -> None:
    """Check a value from another decoder (msgpack): depth, numbers and text.

    Values of other types than those of JSON are not looked at.
    """
    # not recursive: the depth is what is to be checked
    level: list[object] = [value]
    for _ in range(most_depth + 1):
        deeper: list[object] = []
        for one in level:
            if isinstance(one, dict):
                deeper.extend(one)
                deeper.extend(one.values())
            elif isinstance(one, list | tuple):
                deeper.extend(one)
            elif isinstance(one, float):
                if not (has_constants or math.isfinite(one)):
                    raise ForeignDataError(f"{what} contains a number that is not finite")
            elif isinstance(one, int):
                if not _LEAST_INTEGER <= one <= _MOST_INTEGER:
                    raise ForeignDataError(f"{what} contains an integer of more than 64 bits")
            elif isinstance(one, str) and not one.isascii():
                _check_text(one, what)
        if not deeper:
            return
        level = deeper
    raise ForeignDataError(f"{what} is nested more than {most_depth} deep")


def _check_text(text: str, what: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise ForeignDataError(
            f"{what} contains a character that is half of a pair (U+{ord(text[error.start]):04X})"
        ) from error


def decode_model(
    model: type[J], data: bytes | str, what: str, *, most_bytes: int = MOST_BYTES
) -> J:
    """Decode a JSON document as a pydantic model; the message has the first field that is wrong."""
    decode_json(data, what, most_bytes=most_bytes)
    text = data if isinstance(data, str) else data.decode()
    return _checked(lambda: model.model_validate_json(text), what)


def to_model(model: type[M], value: object, what: str) -> M:
    """Convert a decoded value to a pydantic model; the message names the first wrong field."""
    return _checked(lambda: model.model_validate(value), what)


def _checked(validate: Callable[[], D], what: str) -> D:
    try:
        return validate()
    except (ValueError, OverflowError, RecursionError) as error:
        raise ForeignDataError(f"{what} does not fit: {_first_of(error)}") from error


def to_dataclass(kind: type[D], value: object, what: str) -> D:
    """Convert a table to a dataclass of texts, numbers and truth values; entries with a default may
    be missing, others than its fields may not be there.
    """
    found = table(value, what)
    known = {one.name: one for one in dataclasses.fields(cast("Any", kind))}
    for name in found.keys() - known.keys():
        raise ForeignDataError(f"{what} has the unknown entry {shortened(name)}")
    values: dict[str, object] = {}
    for name, one in known.items():
        if name in found:
            check = _CHECKS[getattr(one.type, "__name__", one.type)]
            values[name] = check(found[name], f"{what}.{name}")
        elif one.default is dataclasses.MISSING:
            raise ForeignDataError(f"{name!r} is missing in {what}")
    return kind(**values)


def _first_of(error: Exception) -> str:
    listed: Callable[[], list[dict[str, Any]]] | None = getattr(error, "errors", None)
    if listed is None:
        return type(error).__name__
    first = listed()[0]
    place = ".".join(map(str, first["loc"]))
    return f"{place}: {first['msg']}" if place else str(first["msg"])


def read_bytes(path: Path, *, most_bytes: int = MOST_FILE_BYTES, is_secret: bool = False) -> bytes:
    """Read a regular file of at most `most_bytes`; a secret, only if none but its owner can.

    Raises:
        FileNotFoundError: there is none.
        ForeignDataError: it is a folder, a device or a pipe, is larger, cannot be read, or is a
            secret that others can read.
    """
    try:
        # a pipe without a writer must not block
        with open(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), "rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            if not stat.S_ISREG(mode):
                raise ForeignDataError(f"{path.name} is no regular file")
            if is_secret and mode & (stat.S_IRWXG | stat.S_IRWXO):
                raise ForeignDataError(
                    f"others can read {path.name}", hint=f"Type `chmod 600 {path}`."
                )
            data = file.read(most_bytes + 1)
    except FileNotFoundError:
        raise
    except OSError as error:
        is_folder = error.errno == errno.EISDIR
        told = "is a directory" if is_folder else f"cannot be read: {error.strerror or error}"
        raise ForeignDataError(f"{path.name} {told}") from error
    if len(data) > most_bytes:
        raise ForeignDataError(f"{path.name} has more than {most_bytes} bytes")
    return data


def read_text(path: Path, *, most_bytes: int = MOST_FILE_BYTES, is_secret: bool = False) -> str:
    """Read a file of UTF-8, without the byte order mark that some editors put in front. Raises as
    `read_bytes`, and ForeignDataError for another encoding.
    """
    data = read_bytes(path, most_bytes=most_bytes, is_secret=is_secret)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ForeignDataError(
            f"{path.name} is not UTF-8 (byte {error.start})", hint="Save it as UTF-8."
        ) from error


def decode_toml(text: str, what: str) -> Document:
    """Decode a TOML document; numbers that are not finite are refused, as in JSON."""
    try:
        value = tomllib.loads(text)
    except RecursionError as error:
        raise ForeignDataError(f"{what} is nested more than {MOST_DEPTH} deep") from error
    except ValueError as error:
        raise ForeignDataError(f"{what} is not valid TOML: {error}") from error
    check_value(value, what)
    return value


def read_json(path: Path, *, most_bytes: int = MOST_FILE_BYTES, has_constants: bool = False) -> Any:
    """Decode a file. Raises as `read_bytes` and `decode_json`."""
    data = read_bytes(path, most_bytes=most_bytes)
    return decode_json(data, path.name, most_bytes=most_bytes, has_constants=has_constants)


def write_private(path: Path, text: str) -> None:
    """Replace a state file atomically by one that only its owner may read: whatever ends a process
    or the machine meanwhile, the file holds the old or the new text. Its folder is created.

    Raises:
        OSError: it cannot be written; the old one stays.
    """
    make_log_directory(path.parent)
    # of each writer alone; a link that has its name is not followed
    new = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}")
    new.unlink(missing_ok=True)
    try:
        opened = os.open(new, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o600)
        with open(opened, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    except OSError:
        with suppress(OSError):
            new.unlink(missing_ok=True)
        raise


def type_hashes(description: object) -> dict[str, str]:
    """RIHS01 hashes by full name, in rosidl's description of an interface."""
    listed = items(field(description, "type_hashes"), "type_hashes", most=MOST_TYPE_FIELDS)
    return {
        text(field(one, "type_name"), "type_name"): text(field(one, "hash_string"), "hash_string")
        for one in listed
    }


def field(document: object, name: str) -> Any:
    """A required field."""
    if not isinstance(document, dict) or name not in document:
        raise ForeignDataError(f"{name!r} is missing")
    return document[name]


def table(value: object, what: str, most: int = 1024) -> Document:
    """A table of at most `most` entries."""
    if not isinstance(value, dict) or len(value) > most:
        raise ForeignDataError(f"{what} is no table of at most {most} entries")
    return value


def items(value: object, what: str, *, most: int, least: int = 0) -> list[Any]:
    """A list of `least` to `most` entries."""
    if not isinstance(value, list) or not least <= len(value) <= most:
        raise ForeignDataError(f"{what} is no list of {least} to {most}")
    return value


def text(value: object, what: str, most: int = 256) -> str:
    """Text of at most `most` characters."""
    if not isinstance(value, str) or len(value) > most:
        raise ForeignDataError(f"{what} is no text of at most {most} characters")
    return value


def octets(value: object, what: str) -> bytes:
    """Bytes written in hexadecimal digits."""
    try:
        return bytes.fromhex(text(value, what, MOST_TEXT))
    except ValueError as error:
        raise ForeignDataError(f"{what} is not written in hexadecimal digits") from error


def encodable(text: str) -> str:
    """Text that UTF-8 can encode, for a file: an argument of a command line may be of any bytes."""
    return text.encode("utf-8", "replace").decode()


def choice(value: object, what: str, allowed: Iterable[str]) -> str:
    """One of the allowed words."""
    for word in allowed:
        if value == word:
            return word
    raise ForeignDataError(f"{what} is {shortened(value)}, expected one of {', '.join(allowed)}")


def integer(value: object, what: str, low: int = -(1 << 63), high: int = (1 << 63) - 1) -> int:
    """An integer in a range; neither true nor 1.0."""
    if type(value) is not int or not low <= value <= high:
        raise ForeignDataError(f"{what} is no integer in {low} .. {high}")
    return value


def number(value: object, what: str, low: float = -math.inf, high: float = math.inf) -> float:
    """A finite number in a range."""
    # the bound of an integer also keeps `float` from an OverflowError
    is_integer = type(value) is int and _LEAST_INTEGER <= value <= _MOST_INTEGER
    if not is_integer and (type(value) is not float or not math.isfinite(value)):
        raise ForeignDataError(f"{what} is {shortened(value)}, expected a finite number")
    found = float(cast("float", value))
    if not low <= found <= high:
        raise ForeignDataError(f"{what} is {found:g}, expected {low:g} .. {high:g}")
    return found


def optional_number(
    value: object, what: str, low: float = -math.inf, high: float = math.inf
) -> float | None:
    """A finite number in a range, or None."""
    return None if value is None else number(value, what, low, high)


def truth(value: object, what: str) -> bool:
    """True or false."""
    if not isinstance(value, bool):
        raise ForeignDataError(f"{what} is neither true nor false")
    return value


def numbers(value: object, what: str, count: int) -> list[float]:
    """A list of `count` finite numbers."""
    return [number(one, what) for one in items(value, what, most=count, least=count)]


def named_numbers(value: object, what: str, most: int) -> Mapping[str, float]:
    """Finite numbers by name."""
    found = table(value, what, most)
    return {text(name, what, 64): number(one, f"{what}.{name}") for name, one in found.items()}


_CHECKS: Mapping[object, Callable[[object, str], object]] = {
    "str": partial(text, most=4096),
    "int": integer,
    "float": number,
    "bool": truth,
}

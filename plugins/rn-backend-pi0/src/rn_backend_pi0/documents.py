"""Reading a checkpoint's JSON documents, with errors that name the file and the key."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from roboneuron.errors import CheckpointError

Document = Mapping[str, object]
_MAX_BYTES = 64 * 2**20


def read_document(path: Path) -> Document:
    """The JSON object in `path`.

    Raises:
        CheckpointError: the file is missing, too large, not JSON, or not an object.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise CheckpointError(f"{path} is {path.stat().st_size} bytes long; a JSON file of a checkpoint is not.")
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise CheckpointError(f"{path} cannot be read as JSON: {error}.") from error
    if not isinstance(value, dict):
        raise CheckpointError(f"{path} holds a {type(value).__name__}, expected an object.")
    return value


def take_object(document: Document, key: str, path: Path) -> Document:
    """The object under `key`. Raises CheckpointError when it is missing or something else."""
    value = document.get(key)
    if not isinstance(value, dict):
        raise CheckpointError(f"{path}: {key!r} is {_shown(value)}, expected an object.")
    return value


def take_list(document: Document, key: str, path: Path) -> list[object]:
    """The list under `key`. Raises CheckpointError likewise."""
    value = document.get(key)
    if not isinstance(value, list):
        raise CheckpointError(f"{path}: {key!r} is {_shown(value)}, expected a list.")
    return value


def take_integer(document: Document, key: str, path: Path, default: int | None = None) -> int:
    """The integer > 0 under `key`. Raises CheckpointError when it is missing without default, or not one."""
    value = document.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise CheckpointError(f"{path}: {key!r} is {_shown(value)}, expected an integer > 0.")
    return value


def take_number(document: Document, key: str, path: Path, default: float) -> float:
    """The number > 0 under `key`. Raises CheckpointError when it is not one."""
    value = document.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < float("inf"):
        raise CheckpointError(f"{path}: {key!r} is {_shown(value)}, expected a number > 0.")
    return float(value)


def _shown(value: object) -> str:
    return "missing" if value is None else repr(value)[:80]

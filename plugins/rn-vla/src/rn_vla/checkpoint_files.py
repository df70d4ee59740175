"""Reading of a model checkpoint's files: regular files of bounded size, one schema for each, one
error class.

For model plugins. A checkpoint may come from anywhere, so no size, type or name in it is trusted.
"""

from __future__ import annotations

import json
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from roboneuron import CheckpointError, RoboNeuronError

T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)

MAX_JSON_BYTES = 8 * 2**20
"""Largest JSON file that describes a model; parsed JSON takes up to 20 times its size in memory."""
MAX_TOKENIZER_BYTES = 64 * 2**20
"""Largest tokenizer.json (PaliGemma's is 34 MB)."""
MAX_HEADER_BYTES = 32 * 2**20
"""Longest header of a safetensors file."""
FAMILIES = {
    "openvla": "openvla (OpenVLA), oft (OpenVLA-OFT)",
    "pi0": "pi0",
    "pi05": "pi0",
    "pi0_fast": "pi0-fast",
    **dict.fromkeys(("act", "diffusion", "smolvla", "vqbet", "xvla"), "lerobot"),
}
"""Backends that run a checkpoint, by the family that its config.json names."""
_LISTED = 12
_INSIDE = (
    "pretrained_model",
    "checkpoints/last/pretrained_model",
    "checkpoints/*/pretrained_model",
    "*/pretrained_model",
    "snapshots/*",
    "*",
)
"""Where programs keep the files of a model below the folder that people name: LeRobot's training,
the cache of the Hugging Face hub, a folder that was unpacked into one of its name.
"""
_FAMILY_KEYS = ("type", "model_type")
_AGAIN = "Check that the checkpoint is complete, or download it again."


def clip(text: object, length: int = 120) -> str:
    """`text` in at most `length` characters, because names and values in messages come from the
    file.
    """
    words = str(text)
    return words if len(words) <= length else f"{words[: length - 4]} ..."


def list_names(names: Iterable[str]) -> str:
    """The first names, clipped, and the number of further ones."""
    known = list(names)
    more = len(known) - _LISTED
    return ", ".join(clip(name, 240) for name in known[:_LISTED]) + (
        f" and {more} more" if more > 0 else ""
    )


def explain_families(family: object) -> str:
    """Hint for a checkpoint of a family that the backend in use does not run."""
    if isinstance(family, str) and family in FAMILIES:
        return f"Choose a backend that runs it: {FAMILIES[family]}."
    known = "; ".join(f"{name!r}: {backends}" for name, backends in FAMILIES.items())
    return f"No backend of RoboNeuron runs that family. Those that read checkpoints run {known}."


def explain_folder(path: Path) -> str:
    """Hint for a file that is missing: what its folder is, and what to name instead."""
    try:
        return _explained(path)
    except (OSError, ValueError):  # ValueError: NUL in the name
        return _AGAIN


def _explained(path: Path) -> str:
    folder = path.parent
    if not folder.is_dir():
        return f"There is no folder {clip(folder, 300)}: name the one that holds {path.name}."
    for inner in _INSIDE:
        for found in sorted(folder.glob(inner)):
            if (found / path.name).is_file():
                return f"Name the folder inside it: {clip(found, 300)}."
    if (folder / "params").is_dir() and not (folder / "config.json").is_file():
        return (
            "It is a checkpoint of openpi in JAX. Convert it with openpi's "
            "examples/convert_jax_model_to_pytorch.py, or serve it with openpi and choose the "
            "backend 'openpi'."
        )
    names = sorted(one.name for one in islice(folder.iterdir(), 1000))
    holds = list_names(names) if names else "nothing"
    return f"{clip(folder, 300)} holds {holds}: name the folder that holds {path.name}."


def check_file(path: Path, max_bytes: int | None = None) -> int:
    """The size of `path` [bytes].

    Raises:
        CheckpointError: it is missing, larger than `max_bytes`, or not a regular file (reading a
            pipe would not end).
    """
    try:
        found = path.stat()
    except (OSError, ValueError) as error:  # ValueError: NUL in the name
        why = "does not exist" if isinstance(error, FileNotFoundError) else "cannot be read"
        raise CheckpointError(f"{clip(path, 300)} {why}.", hint=explain_folder(path)) from error
    if not stat.S_ISREG(found.st_mode):
        raise CheckpointError(f"{path} is not a regular file.", hint=_AGAIN)
    if max_bytes is not None and found.st_size > max_bytes:
        raise CheckpointError(
            f"{path} has {found.st_size} bytes, expected at most {max_bytes}.", hint=_AGAIN
        )
    return found.st_size


def check_safetensors(path: Path) -> None:
    """Raise CheckpointError if a safetensors file is missing, not a regular file, or has too long a
    header.
    """
    size = check_file(path)
    with reading(path, "safetensors"), path.open("rb") as file:
        header = int.from_bytes(file.read(8), "little")
    if not 0 < header <= min(size - 8, MAX_HEADER_BYTES):
        raise CheckpointError(
            f"Weight file {path} ({size} bytes) is truncated or damaged: it names a header of "
            f"{header} bytes.",
            hint=_AGAIN,
        )


@contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """Convert any exception of a parser of `path` to one CheckpointError; the cause is kept.

    Parsers written in Rust panic on some damaged files: an exception that is no `Exception`.
    """
    try:
        yield
    except RoboNeuronError:
        raise
    except RecursionError as error:
        raise CheckpointError(
            f"{path} cannot be read as {what}: it is nested too deeply.", hint=_AGAIN
        ) from error
    except Exception as error:
        raise CheckpointError(
            f"{path} cannot be read as {what}: {clip(error, 200)}", hint=_AGAIN
        ) from error
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise CheckpointError(
            f"{path} cannot be read as {what}: {clip(error, 200)}", hint=_AGAIN
        ) from error


def read_json(path: Path, max_bytes: int = MAX_JSON_BYTES) -> object:
    """Parse a JSON file. Raises CheckpointError if it is missing, too large, not a regular file or
    not JSON.
    """
    check_file(path, max_bytes)
    with reading(path, "JSON"):
        return json.loads(path.read_bytes().decode("utf-8"))


def read_schema(path: Path, model: type[M], max_bytes: int = MAX_JSON_BYTES) -> M:
    """Parse and check a JSON file. Raises CheckpointError for the first error."""
    return check_schema(read_json(path, max_bytes), TypeAdapter(model), path)


def check_schema(raw: object, schema: TypeAdapter[T], source: Path) -> T:
    """Check `raw`, which came from `source`, against the schema. Raises CheckpointError for the
    first error.
    """
    if not isinstance(raw, dict):
        raise CheckpointError(
            f"{source} holds a {type(raw).__name__}, expected an object.", hint=_AGAIN
        )
    try:
        return schema.validate_python(raw)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = clip(".".join(clip(part, 60) for part in first["loc"]) or "it", 200)
        given = (
            ""
            if isinstance(first["input"], dict | list)
            else f" (got {clip(repr(first['input']), 60)})"
        )
        raise CheckpointError(
            f"{source} lacks needed content: {where}: {clip(first['msg'], 300)}{given}.",
            hint=explain_families(first["input"])
            if first["loc"] and first["loc"][-1] in _FAMILY_KEYS
            else f"Compare {source.name} with that of a checkpoint that this backend runs; the "
            "program that saved the model wrote it so.",
        ) from error

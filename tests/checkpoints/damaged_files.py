"""Damages to any file, to JSON, to tokenizers and to weights in safetensors."""

from __future__ import annotations

import copy
import json
import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

Damage = Callable[[Path], None]
Case = tuple[str, Damage]

NUMBERS: dict[type, list[object]] = {
    int: [-64, -1, 0, 7 * 10**8, 2 * 10**9, 10**30, 1e308, "x", True, [], {}],
    float: [-1.0, 1e-300, 1e9, 1e308, float("nan"), float("-inf"), "x", [], {}],
}
"""Replacements of a number."""
MEANT = {
    "q01.0 = 1e-300",
    "q99.0 = 1e-300",
    "max.0 = 1e-300",
    "min.0 = 1e-300",
    "q01.0 = -1.0",
    "q99.0 = -1.0",
    "mean.0 = 1e-300",
    "norm_stats.state.mean.0 = -1.0",
    "norm_stats.actions.mean.0 = -1.0",
}
"""Replacements that are valid in another checkpoint, so that they cannot be detected."""


def files(name: str) -> Iterator[Case]:
    def replaced(make_it: Callable[[Path], object]) -> Damage:
        def damage(directory: Path) -> None:
            (directory / name).unlink()
            make_it(directory / name)

        return damage

    yield f"{name}: absent", replaced(lambda path: None)
    yield f"{name}: empty", replaced(lambda path: path.write_bytes(b""))
    yield f"{name}: a pipe", replaced(os.mkfifo)
    yield f"{name}: a directory", replaced(lambda path: path.mkdir())
    yield f"{name}: an endless device", replaced(lambda path: path.symlink_to("/dev/zero"))
    yield f"{name}: a link to nothing", replaced(lambda path: path.symlink_to("nowhere"))
    yield f"{name}: a hundred gigabytes of zeros", replaced(lambda path: _sparse(path, 100 * 10**9))
    yield (
        f"{name}: random bytes",
        replaced(lambda path: path.write_bytes(bytes(range(255, -1, -1)) * 64)),
    )


def _sparse(path: Path, size: int) -> None:
    with path.open("wb") as file:
        file.truncate(size)


def texts(name: str) -> Iterator[Case]:
    texts = {
        "null": "null",
        "a list": "[]",
        "an empty object": "{}",
        "a text": '"text"',
        "half": '{"half": ',
        "deep objects": '{"a":' * 200_000 + "1" + "}" * 200_000,
        "deep lists": "[" * 500_000,
        "a number of a million digits": '{"a": ' + "9" * 1_000_000 + "}",
        "wide lists": '{"a": [' + "[]," * 1_000_000 + "[]]}",
        "a name of 7 MB": json.dumps({"n" * 7_000_000: 1}),
        "not UTF-8": '{"a": "\udcff"}',
    }
    for what, text in texts.items():
        yield f"{name}: {what}", writer(name, text.encode("utf-8", "surrogateescape"))


def writer(name: str, data: bytes) -> Damage:
    def damage(directory: Path) -> None:
        (directory / name).write_bytes(data)

    return damage


def edited(name: str, edit: Callable[[Any], object]) -> Damage:
    def damage(directory: Path) -> None:
        document = json.loads((directory / name).read_text())
        edit(document)
        (directory / name).write_text(json.dumps(document))

    return damage


def _leaves(value: object, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], object]]:
    """Paths of all numbers; of a list of numbers only the first one."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _leaves(part, (*path, key))
    elif isinstance(value, list):
        for index, part in enumerate(value):
            if index == 0 or isinstance(part, dict | list):
                yield from _leaves(part, (*path, index))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path, value


def place(document: Any, path: tuple[Any, ...], value: object) -> None:
    for key in path[:-1]:
        document = document[key]
    document[path[-1]] = copy.deepcopy(value)


def numbers(name: str, document: object) -> Iterator[Case]:
    for path, old in _leaves(document):
        for value in NUMBERS[type(old)]:
            where = f"{'.'.join(map(str, path))} = {value!r}"
            if where.endswith(tuple(MEANT)):
                continue
            yield f"{name}: {where}", edited(name, lambda d, p=path, v=value: place(d, p, v))


def tokenizers() -> Iterator[Case]:
    name = "tokenizer.json"
    cut = {"direction": "Right", "max_length": 4, "strategy": "LongestFirst", "stride": 0}
    pad = {"strategy": {"Fixed": 60}, "direction": "Right", "pad_to_multiple_of": None}
    pad |= {"pad_id": 0, "pad_type_id": 0, "pad_token": "<unk>"}
    added = {
        "id": 10**6,
        "content": "zebra",
        "single_word": False,
        "lstrip": False,
        "rstrip": False,
    }
    added |= {"normalized": False, "special": False}
    yield "tokenizer.json: truncation", edited(name, lambda d: d.update(truncation=cut))
    yield "tokenizer.json: padding", edited(name, lambda d: d.update(padding=pad))
    yield (
        "tokenizer.json: an added id of a million",
        edited(name, lambda d: d["added_tokens"].append(added)),
    )
    many = [added | {"content": f"zebra{i}"} for i in range(1000)]
    yield (
        "tokenizer.json: a thousand added ids",
        edited(name, lambda d: d["added_tokens"].extend(many)),
    )

    def beyond(document: Any) -> None:
        vocabulary = document["model"]["vocab"]
        vocabulary[next(reversed(vocabulary))] = 3_000_000

    yield "tokenizer.json: an id of three millions", edited(name, beyond)
    yield "tokenizer.json: a negative id", edited(name, lambda d: d["model"]["vocab"].update(zz=-4))


def safetensors(name: str) -> Iterator[Case]:
    def header(edit: Callable[[dict[str, Any]], object]) -> Damage:
        def damage(directory: Path) -> None:
            data = (directory / name).read_bytes()
            length = int.from_bytes(data[:8], "little")
            content = json.loads(data[8 : 8 + length])
            edit(content)
            raw = json.dumps(content).encode()
            (directory / name).write_bytes(
                len(raw).to_bytes(8, "little") + raw + data[8 + length :]
            )

        return damage

    def tensors(edit: Callable[[dict[str, Any]], object]) -> Damage:
        def damage(directory: Path) -> None:
            from safetensors.torch import load_file, save_file

            content = load_file(directory / name)
            edit(content)
            save_file(content, directory / name)

        return damage

    def each(content: dict[str, Any]) -> list[dict[str, Any]]:
        return [entry for key, entry in content.items() if key != "__metadata__"]

    def cast(kind: str) -> Damage:
        def edit(content: dict[str, Any]) -> None:
            import torch

            for key in content:
                content[key] = content[key].to(getattr(torch, kind))

        return tensors(edit)

    def first(value: float) -> Damage:
        return tensors(lambda content: content[max(content)].view(-1)[0].fill_(value))

    yield f"{name}: truncated", lambda d: os.truncate(d / name, (d / name).stat().st_size - 10)
    for length in (0, 1, 2**31, 2**63, 2**64 - 1):
        yield f"{name}: a header of {length} bytes", _overwrite(name, struct.pack("<Q", length))
    yield f"{name}: deep header", writer(name, struct.pack("<Q", 10**6) + b"[" * 10**6)
    yield f"{name}: shape", header(lambda h: each(h)[0].update(shape=[2**40, 2**20]))
    yield f"{name}: negative shape", header(lambda h: each(h)[0].update(shape=[-1]))
    yield f"{name}: offsets", header(lambda h: each(h)[0].update(data_offsets=[0, 2**60]))
    yield (
        f"{name}: overlap",
        header(lambda h: each(h)[1].update(data_offsets=each(h)[0]["data_offsets"])),
    )
    yield f"{name}: number type", header(lambda h: each(h)[0].update(dtype="X9"))
    for kind in ("int64", "int8", "uint8", "bool", "complex64"):
        yield f"{name}: all {kind}", cast(kind)
    for value in (float("nan"), float("inf")):
        yield f"{name}: {value} inside", first(value)
    yield (
        f"{name}: a name of 10 MB",
        tensors(lambda content: content.update({"n" * 10_000_000: content.pop(max(content))})),
    )


def _overwrite(name: str, head: bytes) -> Damage:
    def damage(directory: Path) -> None:
        with (directory / name).open("r+b") as file:
            file.write(head)

    return damage

"""Damages to files of torch.save."""

from __future__ import annotations

import os
import pickle
import struct
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from damaged_files import Case, Damage, writer


class _Execute:
    """A pickle that runs a command when loaded with Python's unpickler."""

    def __reduce__(self) -> Any:
        return os.system, ("touch executed",)


class _Storage:
    """Stands for a storage in a hand-made data.pkl."""

    def __init__(self, count: int) -> None:
        self.count = count


class _Oversized:
    """A tensor that claims to be larger than its storage."""

    def __init__(self, shape: tuple[int, ...], stride: tuple[int, ...]) -> None:
        self.shape, self.stride = shape, stride

    def __reduce__(self) -> Any:
        import torch

        arguments = (_Storage(4), 0, self.shape, self.stride, False, {})
        return torch._utils._rebuild_tensor_v2, arguments


class _Pickler(pickle.Pickler):
    def persistent_id(self, value: object) -> Any:
        import torch

        return (
            ("storage", torch.FloatStorage, "0", "cpu", value.count)
            if isinstance(value, _Storage)
            else None
        )


def _archive(
    content: object, compression: int = zipfile.ZIP_STORED, data: bytes | None = None
) -> Callable[[Path], None]:
    """A file as written by torch.save, with `content` in its data.pkl."""

    def write(path: Path) -> None:
        import io

        buffer = io.BytesIO()
        _Pickler(buffer, protocol=2).dump(content)
        with zipfile.ZipFile(path, "w", compression) as archive:
            archive.writestr("archive/data.pkl", buffer.getvalue() if data is None else data)
            archive.writestr("archive/data/0", b"\0" * 16)
            archive.writestr("archive/version", b"3\n")

    return write


def pickles(name: str) -> Iterator[Case]:
    def saved(change: Callable[[dict[Any, Any]], object]) -> Damage:
        def damage(directory: Path) -> None:
            import torch

            content = torch.load(directory / name, weights_only=True)
            result = change(content)
            torch.save(content if result is None else result, directory / name)

        return damage

    def written(write: Callable[[Path], None]) -> Damage:
        return lambda directory: write(directory / name)

    def cast(kind: str) -> Damage:
        def change(content: dict[Any, Any]) -> None:
            import torch

            for key in content:
                content[key] = content[key].to(getattr(torch, kind))

        return saved(change)

    def fill(content: dict[Any, Any]) -> None:
        content[next(iter(content))].fill_(float("nan"))

    yield f"{name}: a bare pickle that executes", writer(name, pickle.dumps(_Execute()))
    yield f"{name}: an archive that executes", written(_archive({"x": _Execute()}))
    yield f"{name}: a bomb", written(_archive({}, zipfile.ZIP_DEFLATED, b"\0" * 500_000_000))
    yield (
        f"{name}: a memo of four billions",
        written(_archive({}, data=b"\x80\x02}r\xff\xff\xff\xff.")),
    )
    yield (
        f"{name}: a text of an exabyte",
        written(_archive({}, data=b"\x80\x04\x8d" + struct.pack("<Q", 2**60))),
    )
    yield f"{name}: a deep pickle", written(_archive({}, data=b"\x80\x02" + b"(" * 10**6))
    yield f"{name}: no pickle", written(_archive({}, data=b"nonsense"))
    yield (
        f"{name}: larger than its storage",
        written(_archive({"x": _Oversized((10**5, 10**5), (10**5, 1))})),
    )
    yield f"{name}: negative shape", written(_archive({"x": _Oversized((-1,), (1,))}))
    yield f"{name}: a list", saved(lambda content: list(content.values()))
    yield f"{name}: a tensor", saved(lambda content: next(iter(content.values())))
    yield f"{name}: nested", saved(lambda content: {"state_dict": dict(content)})
    for key in (1, None, ("a", 2), 2.5, b"x", True):
        yield (
            f"{name}: the key {key!r}",
            saved(lambda content, k=key: content.update({k: content.pop(next(iter(content)))})),
        )
    yield (
        f"{name}: a name of 10 MB",
        saved(lambda content: content.update({"n" * 10**7: content.pop(next(iter(content)))})),
    )
    for value in (3, "text", None, [1]):
        yield (
            f"{name}: the value {value!r}",
            saved(lambda content, v=value: content.update({next(iter(content)): v})),
        )
    yield (
        f"{name}: sparse",
        saved(lambda content: content.update({max(content): content[max(content)].to_sparse()})),
    )
    yield f"{name}: NaN inside", saved(fill)
    for kind in ("int64", "uint8", "bool", "complex64", "int16"):
        yield f"{name}: all {kind}", cast(kind)
    yield f"{name}: truncated", lambda d: os.truncate(d / name, (d / name).stat().st_size - 10)

"""Headers of `torch.save` files: names and shapes of their tensors, read before torch allocates or
executes anything.

Source: the archive format of torch.save since 1.6: a zip of uncompressed records, `data.pkl` with
the names and shapes, `data/<key>` with the bytes of one storage each.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rn_vla.checkpoint_files import check_file, clip
from roboneuron import CheckpointError

_MAX_HEADER_BYTES = 16 * 2**20
_MAX_RECORDS = 65_536
_ITEM_BYTES = {
    "Float": 4,
    "Double": 8,
    "Half": 2,
    "BFloat16": 2,
    "Long": 8,
    "Int": 4,
    "Short": 2,
    "Char": 1,
}
_ITEM_BYTES |= {"Byte": 1, "Bool": 1, "ComplexFloat": 8, "ComplexDouble": 16}
_HINT = "Use the file as it was published; only dictionaries of plain tensors are read."


@dataclass(frozen=True, kw_only=True, slots=True)
class SavedTensor:
    """One tensor: its shape, and the number type of its storage ("Float", "BFloat16", "Long"
    ...).
    """

    shape: tuple[int, ...]
    kind: str


class _Kind(str):
    """Placeholder of a storage class such as torch.FloatStorage."""


def read_header(path: Path) -> Mapping[str, SavedTensor]:
    """Every tensor of a state dictionary by its name; no code is executed and no storage is read.

    Raises:
        CheckpointError: not such an archive, compressed or damaged, or it holds something other
            than named tensors.
    """
    size = check_file(path)
    try:
        with zipfile.ZipFile(path) as archive:
            records = archive.infolist()
            stored = all(record.compress_type == zipfile.ZIP_STORED for record in records)
            if (
                not stored
                or len(records) > _MAX_RECORDS
                or sum(record.file_size for record in records) > size
            ):
                raise CheckpointError(
                    f"{path} holds compressed or overlapping records, unlike torch.save.",
                    hint=_HINT,
                )
            found = [record for record in records if record.filename.endswith("/data.pkl")]
            if len(found) != 1 or found[0].file_size > _MAX_HEADER_BYTES:
                raise CheckpointError(
                    f"{path} has no single data.pkl of a sensible size.", hint=_HINT
                )
            data = archive.read(found[0])
    except (
        zipfile.BadZipFile,
        EOFError,
        OSError,
        ValueError,
        NotImplementedError,
        RuntimeError,
    ) as error:
        raise CheckpointError(
            f"Weight file {path} ({size} bytes) is truncated or damaged: it is no archive of "
            "torch.save.",
            hint="Download the checkpoint again.",
        ) from error
    folder = found[0].filename.removesuffix("data.pkl") + "data/"
    sizes = {
        r.filename.removeprefix(folder): r.file_size
        for r in records
        if r.filename.startswith(folder)
    }
    try:
        content = _HeaderReader(data, sizes).load()
    except CheckpointError as error:
        raise CheckpointError(f"{path} {error.message}", hint=_HINT) from error
    except Exception as error:  # a pickle can fail in any way
        raise CheckpointError(
            f"{path} holds a damaged list of tensors: {clip(error)}.", hint=_HINT
        ) from error
    if not isinstance(content, dict):
        raise CheckpointError(
            f"{path} holds a {type(content).__name__}, expected a dictionary of tensors.",
            hint=_HINT,
        )
    for name, tensor in content.items():
        if type(name) is not str or not isinstance(tensor, SavedTensor):
            raise CheckpointError(
                f"{path} holds {clip(repr(name))}: {type(tensor).__name__}, expected tensors by "
                "name.",
                hint=_HINT,
            )
    return content


class _HeaderReader(pickle._Unpickler):  # the unpickler in C would allocate by an index in the file
    """Reads names, shapes and number types; allows only the classes named in it."""

    def __init__(self, data: bytes, sizes: Mapping[str, int]) -> None:
        super().__init__(io.BytesIO(data))
        self._sizes = sizes

    def find_class(self, module: str, name: str) -> object:
        if module == "collections" and name == "OrderedDict":
            return OrderedDict
        if module == "torch._utils" and name == "_rebuild_tensor_v2":
            return self._tensor
        if module == "torch._utils" and name == "_rebuild_parameter":
            return lambda tensor, *_: tensor
        if module == "torch" and name.removesuffix("Storage") in _ITEM_BYTES:
            return _Kind(name.removesuffix("Storage"))
        raise CheckpointError(
            f"holds a {clip(module, 60)}.{clip(name, 60)}, expected tensors only; nothing in it "
            "was executed."
        )

    def persistent_load(self, pid: Any) -> tuple[str, int]:
        word, kind, key, _, count = pid
        if word != "storage" or not isinstance(kind, _Kind) or type(count) is not int:
            raise CheckpointError("names a storage in an unknown way.")
        if self._sizes.get(key, -1) != count * _ITEM_BYTES[kind]:
            raise CheckpointError(
                f"names a storage of {count} values, which its record does not hold."
            )
        return kind, count

    @staticmethod
    def _tensor(
        storage: tuple[str, int], offset: int, shape: Any, stride: Any, *_: Any
    ) -> SavedTensor:
        kind, count = storage
        numbers = (offset, *shape, *stride)
        if (
            len(shape) != len(stride)
            or len(shape) > 8
            or not all(type(n) is int and n >= 0 for n in numbers)
        ):
            raise CheckpointError("describes a tensor with an impossible shape.")
        end = offset + sum((n - 1) * step for n, step in zip(shape, stride, strict=True)) + 1
        if math.prod(shape) and end > count:
            raise CheckpointError(
                f"describes a tensor {clip(shape)} that is larger than its storage."
            )
        return SavedTensor(shape=tuple(shape), kind=kind)

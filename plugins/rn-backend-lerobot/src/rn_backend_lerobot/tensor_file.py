"""Small safetensors files, read without PyTorch.

Source: the format's description, 8 bytes of header length, a JSON header, then the values.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rn_vla.checkpoint_files import check_file, check_safetensors, reading
from roboneuron import CheckpointError

_DTYPES = {
    "F64": "<f8",
    "F32": "<f4",
    "F16": "<f2",
    "BF16": "<u2",
    "I64": "<i8",
    "I32": "<i4",
    "I16": "<i2",
    "I8": "i1",
    "U8": "u1",
    "BOOL": "?",
}
MAX_BYTES = 64 * 2**20
"""Size limit of a file of statistics: an image has three numbers per statistic, a state a few."""


def read_tensors(path: Path) -> dict[str, NDArray[np.float64]]:
    """Every tensor of a file as float64, by name.

    Raises:
        CheckpointError: the file is missing, damaged, too large, or contains something other than
            numbers.
    """
    check_file(path, MAX_BYTES)
    check_safetensors(path)
    with reading(path, "safetensors"):
        data = path.read_bytes()
        start = 8 + int.from_bytes(data[:8], "little")
        header = json.loads(data[8:start])
        found: dict[str, NDArray[np.float64]] = {}
        for name, entry in header.items():
            if name == "__metadata__":
                continue
            begin, end = entry["data_offsets"]
            dtype, shape = _DTYPES.get(entry["dtype"]), tuple(entry["shape"])
            if dtype is None:
                raise CheckpointError(
                    f"{path} holds {name!r} as {str(entry['dtype'])[:40]!r}, which is not read.",
                    hint="Write the statistics as float32, as LeRobot does.",
                )
            count = math.prod(shape)
            if end - begin != count * np.dtype(dtype).itemsize or start + end > len(data):
                raise CheckpointError(f"{path} is damaged: {name!r} has the wrong size.")
            values = np.frombuffer(data, dtype, count, start + begin)
            if entry["dtype"] == "BF16":  # the higher half of a float32
                values = (values.astype("<u4") << 16).view("<f4")
            found[name] = values.reshape(shape).astype(np.float64)
        return found

"""Statistics of every type of numbers that safetensors has: read, or refused by name."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rn_backend_lerobot.tensor_file import read_tensors
from roboneuron import CheckpointError

VALUES = [0.0, 1.0, -2.5, 384.0]
BFLOAT16 = {0.0: 0x0000, 1.0: 0x3F80, -2.5: 0xC020, 384.0: 0x43C0}
"""Source: sign, 8 bits of exponent (bias 127), 7 of mantissa."""


def written(folder: Path, dtype: str, data: bytes, count: int) -> Path:
    entry = {"dtype": dtype, "shape": [count], "data_offsets": [0, len(data)]}
    header = json.dumps({"mean": entry}).encode()
    path = folder / "stats.safetensors"
    path.write_bytes(len(header).to_bytes(8, "little") + header + data)
    return path


def test_bfloat16_is_read(tmp_path: Path) -> None:
    data = np.array([BFLOAT16[one] for one in VALUES], "<u2").tobytes()
    assert read_tensors(written(tmp_path, "BF16", data, 4))["mean"].tolist() == VALUES


@pytest.mark.parametrize("dtype", ["F64", "F32", "F16", "I64", "I32", "I16", "I8", "U8", "BOOL"])
def test_other_numbers_are_read(dtype: str, tmp_path: Path) -> None:
    kinds = {"F": "<f", "I": "<i", "U": "<u", "B": "?"}
    bits = dtype.lstrip("FIUBOL")
    values = np.array([0, 1, 1, 0]).astype(kinds[dtype[0]] + (str(int(bits) // 8) if bits else ""))
    found = read_tensors(written(tmp_path, dtype, values.tobytes(), 4))["mean"]
    assert found.dtype == np.float64
    assert found.tolist() == [0.0, 1.0, 1.0, 0.0]


def test_others_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="'F8_E4M3'") as caught:
        read_tensors(written(tmp_path, "F8_E4M3", bytes(4), 4))
    assert "float32" in caught.value.hint

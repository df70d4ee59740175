"""Parts of the checkpoint folders in these tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

DATA = Path(__file__).parent / "data"
ARM = tuple(f"fr3_joint{i}" for i in range(1, 8))


def write_tensors(path: Path, tensors: dict[str, Any]) -> None:
    """Write a safetensors file of float32 arrays."""
    header, data = {}, b""
    for name, values in tensors.items():
        raw = np.asarray(values, dtype="<f4").tobytes()
        shape = list(np.shape(values))
        offsets = [len(data), len(data) + len(raw)]
        header[name] = {"dtype": "F32", "shape": shape, "data_offsets": offsets}
        data += raw
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data)

"""A short identifier of a checkpoint's files, equal on every host with a copy."""

from __future__ import annotations

import hashlib
from pathlib import Path

from rn_vla.checkpoint_files import MAX_JSON_BYTES, check_file

_SAMPLES = 16
_SAMPLE_BYTES = 16384


def fingerprint(checkpoint: Path) -> str:
    """Twelve hexadecimal digits over config.json and samples spread over each weight file; takes
    milliseconds even for 15 GB.

    Raises:
        CheckpointError: a file is missing, not a regular file, or the configuration is too large to
            be one.
        OSError: a file cannot be read.
    """
    check_file(checkpoint / "config.json", MAX_JSON_BYTES)
    digest = hashlib.sha256((checkpoint / "config.json").read_bytes())
    for path in sorted(checkpoint.glob("*.safetensors")):
        size = check_file(path)
        digest.update(f"{path.name} {size} ".encode())
        with path.open("rb") as file:
            for sample in range(_SAMPLES):
                file.seek(max(0, size - _SAMPLE_BYTES) * sample // (_SAMPLES - 1))
                digest.update(file.read(_SAMPLE_BYTES))
    return digest.hexdigest()[:12]


def served_name(checkpoint: Path) -> str:
    """Name under which a server of this package serves a checkpoint:
    "<directory>@<fingerprint>".
    """
    return f"{checkpoint.name}@{fingerprint(checkpoint)}"

"""A data set written by lerobot's own writer, in a separate interpreter."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from roboneuron import ConfigurationError, MissingDependencyError, StateError

_SCRIPT = Path(__file__).with_name("lerobot_writer.py")
_NO_LEROBOT = 3
_SHOWN = 300


class LerobotWriter:
    """Receives the rows of a data set, one episode after the other."""

    def __init__(self, stream: IO[bytes], features: Sequence[str]) -> None:
        self._stream = stream
        self._features = features

    def begin(self, instruction: str) -> None:
        """Begin an episode."""
        self._stream.write(b"T" + json.dumps(instruction).encode() + b"\n")

    def add(self, row: Mapping[str, NDArray[np.generic]]) -> None:
        """Add a row: arrays in the types and shapes of the features."""
        self._stream.write(b"F")
        for name in self._features:
            self._stream.write(np.ascontiguousarray(row[name]).data)

    def end(self) -> None:
        """End the episode."""
        self._stream.write(b"E")


@contextmanager
def lerobot_writer(
    python: Path,
    root: Path,
    *,
    fps: int,
    features: Mapping[str, Mapping[str, object]],
    robot_type: str | None,
    codec: str,
) -> Iterator[LerobotWriter]:
    """A writer into `root`, which must not exist; the data set is complete after the block.

    Args:
        python: an interpreter with lerobot.
        features: features of the rows, in this order, without those that lerobot adds itself.
        codec: "av1" or "h264".

    Raises:
        ConfigurationError: there is no such interpreter.
        MissingDependencyError: it has no lerobot, or another release.
        StateError: lerobot has failed; contains its output.
    """
    about = {
        "root": str(root.absolute()),
        "fps": fps,
        "features": features,
        "robot_type": robot_type,
        "codec": codec,
    }
    with tempfile.TemporaryFile() as said:
        try:
            process = subprocess.Popen(
                [str(python), "-I", str(_SCRIPT)], stdin=subprocess.PIPE, stdout=said, stderr=said
            )
        except OSError as error:
            raise ConfigurationError(
                f"{python} cannot be run: {error.strerror}.",
                hint="Name the interpreter of an environment with lerobot.",
            ) from error
        assert process.stdin is not None
        is_told = False
        try:
            with suppress(BrokenPipeError):  # exit status and last output contain the reason
                process.stdin.write(json.dumps(about, allow_nan=False).encode() + b"\n")
                yield LerobotWriter(process.stdin, list(features))
                process.stdin.close()
                is_told = True
            status = process.wait()
        finally:
            process.kill()
            process.wait()
            with suppress(BrokenPipeError):
                process.stdin.close()
        if status or not is_told:
            said.seek(0)
            _raise(python, status, said.read().decode("utf-8", "replace").strip())


def _raise(python: Path, status: int, text: str) -> None:
    last = (text.splitlines() or ["it said nothing"])[-1][:_SHOWN]
    if status == _NO_LEROBOT:
        raise MissingDependencyError(
            f"{python} has no lerobot that can be used: {last}.",
            hint="In a checkout, `make .venv-lerobot` makes an environment with lerobot 0.6.1.",
        )
    raise StateError(f"The writer of lerobot has failed with status {status}: {last}")

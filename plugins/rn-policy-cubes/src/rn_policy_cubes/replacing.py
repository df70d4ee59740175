"""Atomic replacement of files, with an error message if the disk is full."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from roboneuron import StateError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path to write to, which replaces `path` on success; otherwise the old file stays.

    Raises:
        StateError: it cannot be written.
    """
    unfinished = path.with_suffix(".part")
    try:
        yield unfinished
        unfinished.rename(path)
    except (OSError, RuntimeError) as error:  # torch reports a full disk as a RuntimeError
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise StateError(
            f"{path} cannot be written: {reason}.",
            hint="Free space on that disk or mend the permissions; the same command goes on where "
            "it was.",
        ) from error

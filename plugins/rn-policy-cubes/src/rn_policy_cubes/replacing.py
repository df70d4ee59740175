"""Files that are replaced at once or not at all, and a sentence when the disk does not take
them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from roboneuron import StateError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a path to write to, which becomes `path` when that has worked; otherwise what was there
    stays.

    Raises:
        StateError: it cannot be written.
    """
    unfinished = path.with_suffix(".part")
    try:
        yield unfinished
        unfinished.rename(path)
    except (OSError, RuntimeError) as error:  # torch tells a full disk as the latter
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise StateError(
            f"{path} cannot be written: {reason}.",
            hint="Free space on that disk or mend the permissions; the same command goes on where "
            "it was.",
        ) from error

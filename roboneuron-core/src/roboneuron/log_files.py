"""Log files: their permissions, and escaping of text that could control a terminal or imitate an
entry.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
FILE_MODE, DIRECTORY_MODE = 0o640, 0o750
"""Logs contain instructions, paths and names: the owner writes them, the group reads them."""
_RETRY_S = 0.005
LOCK_S = 2.0
"""Longest wait for a lock that is held for milliseconds; a process that keeps it longer is
frozen.
"""
_RAW = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u115f\u1160\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f"
    "\u3164\ufe00-\ufe0f\ufeff\uffa0\ufff9-\ufffb\ud800-\udfff\U000e0000-\U000e0fff]"
)
"""Control characters except tab and newline, and characters that reverse or hide text. Source:
Unicode, categories Cc and Cf, and Default_Ignorable_Code_Point.
"""
_MARKS = re.compile("(?<=[\u0300-\u036f]{4})[\u0300-\u036f]+")
"""Combining marks beyond the fourth of a letter, which would cover the lines above."""
MOST_SHOWN = 300
_TAIL_BYTES = 64 * 1024
"""Bytes read from a log's end; a model may have logged gigabytes."""


def make_log_directory(path: Path) -> None:
    """Create a directory; its new parts can neither be listed nor entered by others.

    Raises:
        OSError: it cannot be created.
    """
    for folder in reversed([path, *path.parents]):
        if not folder.exists():
            folder.mkdir(mode=DIRECTORY_MODE, exist_ok=True)


def opener(path: str, flags: int) -> int:
    """For `open`: new files, and the folders above them, are not readable by others."""
    if flags & os.O_CREAT:
        make_log_directory(Path(path).parent)
    return os.open(path, flags | os.O_CLOEXEC, FILE_MODE)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock `<path>.lock` exclusively on this machine; the kernel releases that of a
    process that dies.

    Raises:
        OSError: it cannot be created, or another process keeps it for over `LOCK_S`.
    """
    with open(f"{path}.lock", "a", opener=opener) as file:
        _lock(file.fileno(), time.monotonic() + LOCK_S)
        yield


def _lock(descriptor: int, deadline_s: float) -> None:
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() > deadline_s:
                raise TimeoutError(
                    errno.ETIMEDOUT, f"another process has kept its lock for {LOCK_S:g} s"
                ) from None
        time.sleep(_RETRY_S)


def escaped(text: str) -> str:
    """The text with control characters as \\x1b and the like; further lines are indented, so that
    none looks like a log entry.
    """
    plain = _RAW.sub(lambda m: m.group().encode("unicode_escape").decode(), text)
    return _MARKS.sub("", plain).replace("\n", "\n    ")


def printable(text: str, most: int = MOST_SHOWN) -> str:
    """What others have written (a client, a node, a file, a server), for the eyes of a person: one
    line of at most `most` characters, with everything escaped that could control a terminal, or
    reverse or hide text. Printable text stays as it is.
    """
    # cut before and after: escaping makes up to ten characters of one
    line = escaped(text[: most + 1]).replace("\n    ", "\\n").replace("\t", " ")
    return line if len(line) <= most else f"{line[: most - 4]} ..."


def quoted(text: str, most: int = MOST_SHOWN) -> str:
    """`printable` text between quotation marks, which it cannot close."""
    return '"' + printable(text, most).replace('"', "'") + '"'


class PlainFormatter(logging.Formatter):
    """Formatter with FORMAT and `escaped`: text of agents and plugins in a message cannot forge an
    entry.
    """

    def __init__(self) -> None:
        super().__init__(FORMAT)

    def format(self, record: logging.LogRecord) -> str:
        """See logging."""
        return escaped(super().format(record))


def begin_logging(level: int | str) -> None:
    """Configure logging to stderr, once per process: a second call changes nothing.

    Args:
        level: level of the log, such as logging.INFO or "INFO".
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(PlainFormatter())
    logging.basicConfig(level=level, handlers=[handler])


def read_tail(path: Path, *, lines: int, offset: int = 0) -> tuple[str, ...]:
    """Return the last `lines` lines after byte `offset`, from at most the last 64 KiB; empty if
    there is no such file.
    """
    try:
        with path.open("rb") as file:
            start = max(offset, file.seek(0, os.SEEK_END) - _TAIL_BYTES)
            file.seek(start)
            found = file.read().decode("utf-8", errors="replace").splitlines()
    except FileNotFoundError:
        return ()
    if start > offset and len(found) > 1:
        found = found[1:]
    return tuple(found[-lines:])

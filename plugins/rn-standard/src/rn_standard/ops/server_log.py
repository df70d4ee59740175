"""Log file of the server, next to those of its modules, bounded in size."""

from __future__ import annotations

import logging
import sys
from contextlib import suppress
from io import TextIOWrapper
from logging.handlers import RotatingFileHandler
from pathlib import Path

from roboneuron.feature import log_files

log = logging.getLogger(__name__)
FILE_NAME = "server.log"
_BYTES = 4 << 20
"""Size at which a new file is started; one older file is kept."""


class _PrivateFile(RotatingFileHandler):
    """A file of its owner; a disk that cannot be written costs records, and is reported once."""

    is_failing = False

    def _open(self) -> TextIOWrapper:
        return open(self.baseFilename, self.mode, encoding=self.encoding, opener=log_files.opener)  # type: ignore[return-value]

    def handleError(self, record: logging.LogRecord) -> None:
        """Report the first failure to the other handlers."""
        if not self.is_failing:
            self.is_failing = True  # first: the report comes here too
            log.error("%s cannot be written: %s.", self.baseFilename, sys.exc_info()[1])

    def close(self) -> None:
        """Close the file; what is still buffered is lost on a full disk."""
        with suppress(OSError):
            super().close()


class ServerLog:
    """Writes the records of this process's loggers to a file, from level "info" or lower, between
    `open` and `close`.

    Other handlers receive the same records as before.

    Args:
        directory: its folder; created if missing.
    """

    def __init__(self, directory: Path) -> None:
        self.path = directory / FILE_NAME
        self._handler: logging.Handler | None = None
        self._level = logging.NOTSET
        self._quiet: list[logging.Handler] = []

    def open(self) -> None:
        """Start writing; does nothing the second time. If the disk cannot be written, only the log
        is missing.
        """
        if self._handler is not None:
            return
        with suppress(OSError):
            self._handler = _PrivateFile(
                self.path, maxBytes=_BYTES, backupCount=1, encoding="utf-8"
            )
            self._handler.setFormatter(log_files.PlainFormatter())
            root = logging.getLogger()
            self._level = root.level
            if root.level > logging.INFO:
                self._quiet = [handler for handler in root.handlers if handler.level < root.level]
                for handler in self._quiet:
                    handler.setLevel(root.level)
                root.setLevel(logging.INFO)
            root.addHandler(self._handler)

    def close(self) -> None:
        """Stop writing; idempotent."""
        if self._handler is not None:
            root = logging.getLogger()
            root.removeHandler(self._handler)
            root.setLevel(self._level)
            for handler in self._quiet:
                handler.setLevel(logging.NOTSET)
            self._quiet = []
            self._handler.close()
            self._handler = None

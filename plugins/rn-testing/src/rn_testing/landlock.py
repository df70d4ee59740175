"""Forbid this thread, and all that it starts, to write below a folder or to read others.

The kernel refuses (EACCES) whatever program tries, so that a guard with it needs no list of the
ways to write. Source: Linux, Documentation/userspace-api/landlock.rst and uapi/linux/landlock.h.
"""

from __future__ import annotations

import ctypes
import errno
import os
import stat
from dataclasses import dataclass
from pathlib import Path

_CREATE, _ADD, _RESTRICT = 444, 445, 446
"""Numbers of the system calls, equal on all processors."""
_VERSION, _BENEATH, _NO_NEW_PRIVILEGES = 1, 1, 38
_READ_FILE, _WRITE_FILE, _TRUNCATE, _REFER = 1 << 2, 1 << 1, 1 << 14, 1 << 13
_REMOVE_AND_MAKE = sum(1 << bit for bit in range(4, 13))
_OLDEST = 3
"""Version (Linux 6.2) that can permit moves between folders and forbid to truncate files."""
READ = _READ_FILE
ALL = _READ_FILE | _WRITE_FILE | _TRUNCATE | _REFER | _REMOVE_AND_MAKE
_OF_FILES = _READ_FILE | _WRITE_FILE | _TRUNCATE


class _Ruleset(ctypes.Structure):
    _fields_ = (("handled", ctypes.c_uint64),)


class _Beneath(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("allowed", ctypes.c_uint64), ("parent", ctypes.c_int32))


@dataclass(frozen=True)
class WriteBounds:
    """What is forbidden; absolute paths without symbolic links.

    Attributes:
        read_only: nothing below may be written, made, moved or removed.
        hidden: nor may files here and below be read; they need not exist.
        writable: exceptions to `read_only`.
    """

    read_only: frozenset[Path]
    hidden: frozenset[Path] = frozenset()
    writable: frozenset[Path] = frozenset()

    def grants(self, path: Path = Path("/"), rights: int = ALL) -> dict[Path, int]:
        """Rights by path; a folder above one with other rights is replaced by its entries, so
        that nothing can be made in it.
        """
        if path in self.hidden or path.is_symlink():
            return {}
        if path in self.read_only:
            rights = READ
        if path in self.writable:
            rights = ALL
        others = self.hidden | (self.read_only if rights == ALL else self.writable)
        if not any(path in other.parents for other in others):
            return {path: rights}
        try:
            entries = sorted(path.iterdir())
        except OSError:  # it does not exist, or nobody but its owner may look
            return {}
        return {
            found: right for entry in entries for found, right in self.grants(entry, rights).items()
        }


def is_available() -> bool:
    """True if this kernel can do it."""
    try:
        return _call(_CREATE, None, 0, _VERSION) >= _OLDEST
    except OSError:
        return False


def restrict_thread(bounds: WriteBounds) -> None:
    """Apply the bounds to the calling thread and to all threads and processes that it starts, for
    good. Mounting is forbidden to them too.

    Raises:
        OSError: the kernel refuses; see `is_available`.
    """
    handled = _Ruleset(ALL)
    rules = _call(_CREATE, ctypes.byref(handled), ctypes.sizeof(handled), 0)
    try:
        for path, rights in bounds.grants().items():
            _add(rules, path, rights)
        try:
            _call(_RESTRICT, rules, 0)
        except PermissionError:  # only root may without promising to gain no privileges
            ctypes.CDLL(None).prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
            _call(_RESTRICT, rules, 0)
    finally:
        os.close(rules)


def _add(rules: int, path: Path, rights: int) -> None:
    try:
        descriptor = os.open(path, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:  # it has just been removed
        return
    try:
        if not stat.S_ISDIR(os.fstat(descriptor).st_mode):
            rights &= _OF_FILES
        _call(_ADD, rules, _BENEATH, ctypes.byref(_Beneath(rights, descriptor)), 0)
    finally:
        os.close(descriptor)


def _call(number: int, *arguments: object) -> int:
    library = ctypes.CDLL(None, use_errno=True)
    result = int(library.syscall(ctypes.c_long(number), *arguments))
    if result < 0:
        code = ctypes.get_errno()
        raise OSError(code, f"Landlock: {errno.errorcode.get(code, code)}")
    return result

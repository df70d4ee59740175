"""Values referenced by C code, kept alive as long as the process."""

from __future__ import annotations

import ctypes
from typing import TypeVar

Kept = TypeVar("Kept")
_kept: list[object] = []


def keep(value: Kept) -> Kept:
    """Keep a value alive as long as the process."""
    _kept.append(value)
    return value


def address_of(value: ctypes.Structure) -> int:
    """Address of a structure, which is kept alive as long as the process."""
    return ctypes.addressof(keep(value))

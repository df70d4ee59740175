"""Values that C code has pointers to: they live as long as the process."""

from __future__ import annotations

import ctypes
from typing import TypeVar

Kept = TypeVar("Kept")
_kept: list[object] = []


def keep(value: Kept) -> Kept:
    """Let a value live as long as the process."""
    _kept.append(value)
    return value


def address_of(value: ctypes.Structure) -> int:
    """Address of a structure, which then lives as long as the process."""
    return ctypes.addressof(keep(value))

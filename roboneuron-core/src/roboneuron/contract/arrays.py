"""Read-only arrays of contract values: a plugin that reuses a buffer cannot change values it has
passed on.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

F64 = NDArray[np.float64]


def freeze(value: object, *names: str, dtype: DTypeLike | None = np.float64) -> None:
    """Replace the named array fields of a frozen dataclass by read-only copies; called from
    `__post_init__`.

    Fields that are None stay None; with `dtype` None an array keeps its dtype. An array that is
    read-only already and owns its memory is not copied again, so that `dataclasses.replace` copies
    only what it changes.
    """
    for name in names:
        array = getattr(value, name)
        if array is not None:
            object.__setattr__(value, name, _frozen(array, dtype))


class ReadOnly:
    """Base of frozen dataclasses: fields that are annotated as F64 are read-only copies."""

    __slots__ = ()
    _arrays: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls) -> None:
        cls._arrays = tuple(name for name, kind in cls.__annotations__.items() if "F64" in kind)

    def __post_init__(self) -> None:
        freeze(self, *self._arrays)


def read_only_view(array: NDArray[Any]) -> NDArray[Any]:
    """Return a view that cannot be written through. No pixel is copied, so the owner must not
    modify the memory.
    """
    view = array.view()
    view.flags.writeable = False
    return view


def _frozen(values: ArrayLike, dtype: DTypeLike | None) -> NDArray[Any]:
    array: NDArray[Any] = np.asarray(values, dtype=dtype)
    if array.flags.owndata and not array.flags.writeable:
        return array
    copy = array.copy()
    copy.flags.writeable = False
    return copy

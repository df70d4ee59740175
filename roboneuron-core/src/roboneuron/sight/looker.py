"""The feature that looks, as others use it, and targets that a call names by object or mark."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from roboneuron.contract import F64
from roboneuron.contract.locator import LocatedObject
from roboneuron.errors import InvalidInputError, NotReadyError
from roboneuron.server.host import Host
from roboneuron.sight.marks import CellLook, find_object, name_of, nearest_like, told_name

__all__ = ["seen_top"]
"""Names that other distributions may use."""

SIGHT = "sight"
"""Name of the feature."""
_MOVED_M = 0.05
"""An object of a mark that is seen again at most so far from where it was is the same one."""


@runtime_checkable
class Looker(Protocol):
    """Looks at the cell; usable from any thread."""

    def look(self, who: str, newer_than_ns: int = 0, labels: Sequence[str] = ()) -> CellLook:
        """Look for a client, whose marks these become; blocks for at most a second, and for what
        the locator takes beyond that.

        Args:
            who: the client.
            newer_than_ns: only with pictures taken later, ROS clock [ns].
            labels: what to look for from now on, see `LabelLocator`; empty for what the client has
                said before.

        Raises:
            InvalidInputError: the locator takes no labels.
            RoboNeuronError: ROS cannot be joined.
        """

    def forget(self, one: LocatedObject) -> None:
        """Forget where an object was: it is moved now."""

    @property
    def table_m(self) -> float:
        """Height of the table in the base frame [m]."""

    def last_look(self, who: str) -> CellLook | None:
        """The last look of a client."""


def looker_of(host: Host) -> Looker:
    """The feature. Raises NotReadyError without it."""
    feature: object = host.features.loaded.get(SIGHT)
    if not isinstance(feature, Looker):
        raise NotReadyError(
            "Nothing looks at the cell here.",
            hint="The feature 'sight' does; see disabled_plugins.",
        )
    return feature


def seen_target(
    looker: Looker, who: str, name: str, mark: int | None
) -> tuple[CellLook, LocatedObject]:
    """A new look, and the object in it that a call means.

    Args:
        looker: the feature.
        who: the client.
        name: words of the object; empty for a mark.
        mark: of the client's last look.

    Raises:
        InvalidInputError: it means none, or several.
        NotReadyError: nothing can be seen, or the object of the mark is no longer seen there.
    """
    if bool(name) == (mark is not None):
        raise InvalidInputError("Give an object, or a mark of your last look.", path="object")
    before = looker.last_look(who) if mark is not None else None
    marked = None if before is None or mark is None else find_object(before.objects, mark)
    look = looker.look(who)
    if not look.view.images:
        told = "; ".join(f"{name}: {text}" for name, text in look.view.problems.items())
        raise NotReadyError(f"Nothing is seen. {told or 'There is no camera.'}")
    if look.failure:
        raise NotReadyError(f"The locator does not work: {look.failure}")
    if mark is None:
        return look, find_object(look.objects, name)
    if marked is None:
        return look, find_object(look.objects, mark)
    found = nearest_like(look.objects, marked, _MOVED_M)
    if found is None:
        raise NotReadyError(
            f"{told_name(marked)} of mark {mark} is no longer seen where it was.",
            hint="Call look, and use its marks.",
        )
    return look, found


def seen_top(host: Host, who: str, name: str, mark: int | None) -> tuple[F64, str]:
    """The middle of the top of the object that a call means, (3,) in the base frame [m], and what
    it is called. Raises as `looker_of` and `seen_target`.
    """
    _, one = seen_target(looker_of(host), who, name, mark)
    return one.position_m + np.array([0.0, 0.0, float(one.size_m[2]) / 2]), name_of(one)

"""Buffer of camera images between the receiving threads and the reading one."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from roboneuron import StateError

T = TypeVar("T")


@dataclass(kw_only=True, slots=True)
class _Slot(Generic[T]):
    """One camera: its newest item, and the time of its next turn [s, monotonic]."""

    period_s: float
    item: T | None = None
    due_s: float = 0.0
    taken_s: float = 0.0


class Arrivals(Generic[T]):
    """The newest item of each camera, returned in turns and at a bounded rate; any thread may call
    any method.

    Args:
        periods_s: shortest time between two items by camera [s]; 0 for no bound.
    """

    def __init__(self, periods_s: Mapping[str, float]) -> None:
        self._slots: dict[str, _Slot[T]] = {
            name: _Slot(period_s=period_s) for name, period_s in periods_s.items()
        }
        self._changed = threading.Condition()
        self._open = False

    def open(self) -> None:
        """Discard old items and accept new ones. Raises StateError if it is already open."""
        with self._changed:
            if self._open:
                raise StateError("The cameras are open already.")
            self._open = True
            for slot in self._slots.values():
                slot.item, slot.due_s = None, 0.0

    def close(self) -> bool:
        """Accept no more items and end a `take` in progress; return True if it was open."""
        with self._changed:
            was_open, self._open = self._open, False
            for slot in self._slots.values():
                slot.item = None
            self._changed.notify_all()
            return was_open

    def put(self, camera: str, item: T) -> None:
        """Store an item of a camera; its previous, unread one is dropped."""
        with self._changed:
            if self._open:
                self._slots[camera].item = item
                self._changed.notify_all()

    def is_held(self, camera: str) -> bool:
        """True if an item waits for the camera's next turn."""
        with self._changed:
            return self._slots[camera].item is not None

    def take(self, deadline_s: float) -> tuple[str, T] | None:
        """Return camera and item, from the camera served least recently; None if nothing came by
        then [monotonic].

        Raises:
            StateError: it is closed, or was closed meanwhile.
        """
        with self._changed:
            while True:
                if not self._open:
                    raise StateError("The cameras are not open.", hint="Call open() first.")
                now_s = time.monotonic()
                held = [(name, slot) for name, slot in self._slots.items() if slot.item is not None]
                due = [(name, slot) for name, slot in held if slot.due_s <= now_s]
                if due:
                    name, slot = min(due, key=lambda entry: entry[1].taken_s)
                    return name, self._hand_out(slot, now_s)
                if now_s >= deadline_s:
                    return None
                self._changed.wait(min([deadline_s, *(slot.due_s for _, slot in held)]) - now_s)

    @staticmethod
    def _hand_out(slot: _Slot[T], now_s: float) -> T:
        """Keep the time grid if this item is late by less than a period, otherwise start a
        new one.
        """
        item, slot.item, slot.taken_s = slot.item, None, now_s
        assert item is not None
        if now_s - slot.due_s > slot.period_s:
            slot.due_s = now_s
        slot.due_s += slot.period_s
        return item

"""Shares of the event loop: whoever sends much waits behind itself, not before others."""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

T = TypeVar("T")
AT_ONCE, AT_ONCE_OF_ONE = 4, 2
"""Requests that are begun and young, of all holders and of each. Each takes milliseconds of the
event loop and of a thread, for whose interpreter lock the loop waits.
"""
YOUNG_S = 0.1
"""A request that takes longer, such as a task, does not count any more."""


class FairQueue(Generic[T]):
    """Items of several owners, which are taken from one owner after the other."""

    def __init__(self) -> None:
        self._items: dict[str, deque[T]] = {}

    def __iter__(self) -> Iterator[T]:
        return (item for items in self._items.values() for item in items)

    def __bool__(self) -> bool:
        return bool(self._items)

    def put(self, owner: str, item: T) -> None:
        """Add an item behind those of its owner."""
        self._items.setdefault(owner, deque()).append(item)

    def take(self, may: Callable[[str], bool] = lambda owner: True) -> tuple[str, T] | None:
        """Remove the oldest item of the owner whose turn it is, among those that `may`; None if
        there is none.
        """
        owner = next((one for one in self._items if may(one)), None)
        if owner is None:
            return None
        items = self._items.pop(owner)
        item = items.popleft()
        if items:
            self._items[owner] = items  # behind the others
        return owner, item

    def take_longest(self, besides: str) -> T | None:
        """Remove the newest item of the owner with the most; None if `besides` has as many."""
        longest = max(self._items.values(), key=len, default=None)
        if longest is None or len(longest) <= len(self._items.get(besides, ())):
            return None
        item = longest.pop()
        self._items = {owner: items for owner, items in self._items.items() if items}
        return item

    def clear(self) -> None:
        """Remove all items."""
        self._items.clear()


class BegunRequest:
    """A begun request; `end` it."""

    def __init__(self, end: Callable[[], object]) -> None:
        self._end: Callable[[], object] | None = end
        self._timer = asyncio.get_running_loop().call_later(YOUNG_S, self.end)

    def end(self) -> None:
        """It does not count any more; idempotent."""
        ending, self._end = self._end, None
        self._timer.cancel()
        if ending is not None:
            ending()


class RequestShares:
    """Begins the requests of one holder after the other, a few at a time; used on one event loop
    only.
    """

    def __init__(self) -> None:
        self._begun: Counter[str] = Counter()
        self._waiting: FairQueue[asyncio.Future[BegunRequest]] = FairQueue()

    def at_once(self, holder: str) -> BegunRequest | None:
        """Begin a request; None if it has to `wait`."""
        return self._begin(holder) if self._may(holder) else None

    async def wait(self, holder: str) -> BegunRequest:
        """Begin a request when it is its turn."""
        future: asyncio.Future[BegunRequest] = asyncio.get_running_loop().create_future()
        self._waiting.put(holder, future)
        try:
            return await future
        except asyncio.CancelledError:
            if future.done() and not future.cancelled():
                future.result().end()
            raise

    def _may(self, holder: str) -> bool:
        return self._begun[holder] < AT_ONCE_OF_ONE and self._begun.total() < AT_ONCE

    def _begin(self, holder: str) -> BegunRequest:
        self._begun[holder] += 1
        return BegunRequest(lambda: self._ended(holder))

    def _ended(self, holder: str) -> None:
        self._begun[holder] -= 1
        if not self._begun[holder]:
            del self._begun[holder]
        while (found := self._waiting.take(self._may)) is not None:
            owner, future = found
            if not future.done():
                future.set_result(self._begin(owner))

"""A queue that several agencies share: they are served in turn, however much one of them has waiting."""

from __future__ import annotations

import threading
from collections import deque
from itertools import chain
from queue import Empty
from typing import Generic, TypeVar

ItemT = TypeVar("ItemT")
_REMEMBERED = 10_000  # owners whose last turn is remembered; source: by hand, far above the agencies of a server


class FairQueue(Generic[ItemT]):
    """Items of several owners. The owner whose last turn is longest ago is served next, with its oldest item.

    So an item waits for those of its own owner, and meanwhile for one of each other owner, but not for all that others
    have put before it.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: dict[str, deque[ItemT]] = {}
        self._served: dict[str, None] = {}  # owners in the order of their last turns
        self._closed = False

    def put(self, owner: str, item: ItemT) -> None:
        """Add an item behind those of its owner."""
        with self._changed:
            self._waiting.setdefault(owner, deque()).append(item)
            self._changed.notify()

    def get(self, timeout_s: float | None = None) -> ItemT | None:
        """Take the next item and wait for one if there is none; None once the queue is closed and empty.

        Raises
        ------
        Empty
            No item came in the time.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._waiting or self._closed, timeout_s):
                raise Empty
            return self._take() if self._waiting else None

    def __len__(self) -> int:
        """Number of items that wait."""
        with self._changed:
            return sum(map(len, self._waiting.values()))

    def close(self) -> None:
        """Let `get` return None when no item is left."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _take(self) -> ItemT:
        new = (owner for owner in self._waiting if owner not in self._served)
        owner = next(chain(new, (owner for owner in self._served if owner in self._waiting)))
        items = self._waiting[owner]
        item = items.popleft()
        if not items:
            del self._waiting[owner]
        self._served.pop(owner, None)
        self._served[owner] = None
        if len(self._served) > _REMEMBERED:
            del self._served[next(iter(self._served))]
        return item

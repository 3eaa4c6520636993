"""A queue that several agencies share: the one that used least lately is next, however much others have waiting."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from queue import Empty
from typing import Generic, TypeVar

from app.registry.tenancy import EVERY_AGENCY

ItemT = TypeVar("ItemT")
_NO_AGENCY = ("", EVERY_AGENCY)  # work of the server itself
_REMEMBERED = 10_000  # owners that are remembered; source: by hand, far above the agencies of a server
_HALF_LIFE_S = 60.0  # after which half of what an owner used counts; source: by hand
_LATELY_S = 3600.0  # in which an owner that was served counts as one of several; source: by hand


@dataclass(slots=True)
class _Owner(Generic[ItemT]):
    """What waits of an owner and runs for it."""

    urgent: deque[ItemT] = field(default_factory=deque)
    jobs: deque[ItemT] = field(default_factory=deque)
    running: int = 0
    running_jobs: int = 0
    turn: int = 0  # number of its last item; 0: it had none
    served_at_s: float = 0.0
    used_s: float = 0.0  # at `used_at_s`
    used_at_s: float = 0.0

    def used_lately_s(self, now_s: float) -> float:
        return self.used_s * math.exp2((self.used_at_s - now_s) / _HALF_LIFE_S)


class FairQueue(Generic[ItemT]):
    """Items of several owners. The owner that used the least time lately is served next, with its oldest item.

    Among owners that used the same, the one whose last turn is longest ago is next. So an item waits for those of its
    own owner, but not for all that others have put before it.

    Parameters
    ----------
    at_once : int, optional
        Items of one owner between `get` and `done`. None: as many as there are.
    jobs_at_once : int, optional
        Items of one owner put as jobs between `get` and `done`, if another owner waits or was served in the last hour.
    now_s : callable
        A monotonic clock. [s]
    """

    def __init__(
        self, at_once: int | None = None, *, jobs_at_once: int | None = None,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self._at_once, self._jobs_at_once, self._now_s = at_once, jobs_at_once, now_s
        self._changed = threading.Condition()
        self._owners: dict[str, _Owner[ItemT]] = {}  # in the order of their last turns
        self._waiting: dict[str, None] = {}  # owners that have items
        self._turns = 0
        self._closed = False

    def put(self, owner: str, item: ItemT, *, is_job: bool = False) -> None:
        """Add an item behind those of its owner; a job also behind those that are none."""
        with self._changed:
            known = self._owners.setdefault(owner, _Owner())
            (known.jobs if is_job else known.urgent).append(item)
            self._waiting[owner] = None
            self._changed.notify_all()

    def get(self, timeout_s: float | None = None) -> ItemT | None:
        """Take the next item and wait for one if there is none; None once the queue is closed and empty.

        Raises
        ------
        Empty
            No item came in the time.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._closed or self._next() is not None, timeout_s):
                raise Empty
            owner = self._next()
            return None if owner is None else self._take(owner)

    def done(self, owner: str, used_s: float = 0.0, *, is_job: bool = False) -> None:
        """Record that an item of an owner is done, and the time that it used. [s]"""
        with self._changed:
            known, now_s = self._owners.setdefault(owner, _Owner()), self._now_s()
            known.running -= 1
            known.running_jobs -= is_job
            known.used_s, known.used_at_s = known.used_lately_s(now_s) + used_s, now_s
            self._changed.notify_all()

    def __len__(self) -> int:
        """Number of items that wait."""
        with self._changed:
            return sum(len(known.urgent) + len(known.jobs) for known in self._owners.values())

    def close(self) -> None:
        """Let `get` return None when no item is left that may be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _next(self) -> str | None:
        """The owner to serve; None if none has an item that may be taken."""
        now_s = self._now_s()
        ready = [owner for owner in self._waiting if self._may_serve(owner, now_s)]
        if not ready:
            return None
        return min(ready, key=lambda owner: (self._owners[owner].used_lately_s(now_s), self._owners[owner].turn))

    def _may_serve(self, owner: str, now_s: float) -> bool:
        known = self._owners[owner]
        if self._at_once is not None and known.running >= self._at_once:
            return False
        return bool(known.urgent) or (bool(known.jobs) and self._may_run_job(owner, now_s))

    def _may_run_job(self, owner: str, now_s: float) -> bool:
        if self._jobs_at_once is None or self._owners[owner].running_jobs < self._jobs_at_once:
            return True
        return not any(
            other.urgent or other.jobs or other.running or (other.turn and now_s - other.served_at_s < _LATELY_S)
            for name, other in self._owners.items()
            if name not in (owner, *_NO_AGENCY)
        )

    def _take(self, owner: str) -> ItemT:
        known = self._owners.pop(owner)
        is_job = not known.urgent
        item = (known.jobs if is_job else known.urgent).popleft()
        if not (known.urgent or known.jobs):
            del self._waiting[owner]
        self._turns += 1
        known.turn, known.served_at_s = self._turns, self._now_s()
        known.running += 1
        known.running_jobs += is_job
        self._owners[owner] = known
        if len(self._owners) > _REMEMBERED:
            idle = (name for name, other in self._owners.items() if not (other.running or other.urgent or other.jobs))
            if (oldest := next(idle, None)) is not None:
                del self._owners[oldest]
        return item

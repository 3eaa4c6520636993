"""What streams follow: one query for all jobs, and one for all agencies, at each tick, whoever runs the jobs."""

from __future__ import annotations

import asyncio
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Generic, Protocol, TypeVar

import anyio
import structlog
from anyio import to_thread

from app.errors import Unavailable
from app.registry.jobs import JobRow

TICK_S = 0.5
"""Time between two looks. [s] Source: chosen by hand; jobs report their progress about once a second."""
WINDOW_S = 10.0
"""Time over which the rate of a job's steps is taken. [s]"""
StateT = TypeVar("StateT")
StateT_contra = TypeVar("StateT_contra", contravariant=True)
_LOG = structlog.get_logger(__name__)


class _Follower(Protocol[StateT_contra]):
    def notify(self, state: StateT_contra, /) -> None:
        """Note a state."""


class Watch(Generic[StateT]):
    """Looks at all that is followed in this process, together, in one thread, only while there are followers.

    Parameters
    ----------
    read : callable
        States by ids; runs in a thread.
    tick_s : float, optional
    """

    def __init__(self, read: Callable[[Sequence[str]], Mapping[str, StateT]], tick_s: float = TICK_S) -> None:
        self._read, self._tick_s = read, tick_s
        self._followers: dict[str, set[_Follower[StateT]]] = defaultdict(set)
        self._task: asyncio.Task[None] | None = None

    @property
    def is_looking(self) -> bool:
        """Whether somebody follows something."""
        return self._task is not None and not self._task.done()

    @contextmanager
    def following(self, followed_id: str, follower: _Follower[StateT]) -> Iterator[None]:
        """Notify a follower of states while a block runs."""
        self._followers[followed_id].add(follower)
        if not self.is_looking:
            self._task = asyncio.create_task(self._look())
        try:
            yield
        finally:
            self._followers[followed_id].discard(follower)
            if not self._followers[followed_id]:
                del self._followers[followed_id]

    async def _look(self) -> None:
        limiter = anyio.CapacityLimiter(1)
        while self._followers:
            try:
                states = await to_thread.run_sync(self._read, list(self._followers), limiter=limiter)
            except Unavailable:
                states = {}  # the database answers again at one of the next ticks
            except Exception:  # noqa: BLE001 - it is logged, and those who follow wait on
                _LOG.exception("what streams follow could not be read")
                states = {}
            for followed_id, state in states.items():
                for follower in self._followers.get(followed_id, ()):
                    follower.notify(state)
            await asyncio.sleep(self._tick_s)


class _Flag:
    """Set by one task, awaited by another for so long."""

    def __init__(self) -> None:
        self._event = asyncio.Event()

    def set(self) -> None:
        self._event.set()

    async def wait(self, timeout_s: float) -> bool:
        with anyio.move_on_after(timeout_s):
            await self._event.wait()
        was_set = self._event.is_set()
        self._event.clear()
        return was_set


class JobFollower:
    """One who follows a job: only the newest state waits for it, so a slow one costs no memory.

    Attributes
    ----------
    row : JobRow
        The newest state.
    """

    def __init__(self, row: JobRow) -> None:
        self.row = row
        self._steps: deque[tuple[float, int]] = deque()
        self._changed = _Flag()
        self._note(row)

    def notify(self, row: JobRow) -> None:
        """Replace the state."""
        if _progress_of(row) != _progress_of(self.row):
            self.row = row
            self._note(row)
            self._changed.set()

    async def wait(self, timeout_s: float) -> bool:
        """Wait for a new state; returns whether one came in time."""
        return await self._changed.wait(timeout_s)

    def rate_per_s(self) -> float | None:
        """Steps per second in the last seconds; None before two states differ. [1/s]"""
        (first_s, first), (last_s, last) = self._steps[0], self._steps[-1]
        if last <= first or last_s <= first_s:
            return None
        return round((last - first) / (last_s - first_s), 3)

    def _note(self, row: JobRow) -> None:
        now_s = time.monotonic()
        self._steps.append((now_s, row.steps_done or 0))
        while len(self._steps) > 2 and now_s - self._steps[1][0] > WINDOW_S:
            self._steps.popleft()


def _progress_of(row: JobRow) -> tuple[object, ...]:
    """The state that a follower gets; a row that was read for a stream has neither input nor result."""
    return row.state, row.attempts, row.progress, row.steps_done, row.steps_total, row.cancel_requested


class AgencyFollower:
    """One who follows the events of an agency.

    Attributes
    ----------
    after : int
        Id of the last event that it has read.
    """

    def __init__(self, after: int) -> None:
        self.after = after
        self._newer = _Flag()

    def notify(self, newest: int) -> None:
        """There are events up to this one."""
        if newest > self.after:
            self._newer.set()

    async def wait(self, timeout_s: float) -> bool:
        """Wait for newer events; returns whether there are some."""
        return await self._newer.wait(timeout_s)

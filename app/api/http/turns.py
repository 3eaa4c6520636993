"""Turns of bodies: of many that arrive at once, a few go on in each round of the event loop."""

from __future__ import annotations

import asyncio
from collections import deque

AT_ONCE = 2
"""Pieces of bodies that are taken in one round of the event loop. Source: `python -m benchmarks.service --only
overload`; each takes up to half a millisecond, for which every other request waits."""


class Turns:
    """A queue of those who want to go on, first come, first served.

    A body that does not ask for its next piece is not read from its connection either (uvicorn stops at 64 KiB), so a
    round of the event loop takes as long as `AT_ONCE` pieces, however many clients upload.
    """

    def __init__(self) -> None:
        self._waiting: deque[asyncio.Future[None]] = deque()
        self._left = AT_ONCE
        self._is_due = False

    async def wait(self) -> None:
        """Return in a round of the event loop in which there is a turn left."""
        loop = asyncio.get_running_loop()
        if not self._is_due:
            self._is_due = True
            loop.call_soon(self._next_round, loop)
        if self._left and not self._waiting:
            self._left -= 1
            return
        turn = loop.create_future()
        self._waiting.append(turn)
        await turn

    def _next_round(self, loop: asyncio.AbstractEventLoop) -> None:
        self._left = AT_ONCE
        while self._left and self._waiting:
            turn = self._waiting.popleft()
            if not turn.done():  # its request was cancelled
                turn.set_result(None)
                self._left -= 1
        self._is_due = bool(self._waiting)
        if self._is_due:
            loop.call_soon(self._next_round, loop)

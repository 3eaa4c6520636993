"""Bodies take turns: a few go on in each round of the event loop, in the order in which they asked."""

from __future__ import annotations

import asyncio
from collections import Counter

from app.api.http.bodies import AT_ONCE, Turns


def test_a_few_go_on_in_each_round_and_everybody_does_in_the_end() -> None:
    turns, rounds, done = Turns(), Counter[int](), [0] * 20
    now, ahead = 0, 0

    async def client(number: int) -> None:
        nonlocal ahead
        for _ in range(5):
            await turns.wait()
            rounds[now] += 1
            done[number] += 1
            ahead = max(ahead, done[number] - min(done))

    async def count_rounds() -> None:
        nonlocal now
        while True:
            await asyncio.sleep(0)
            now += 1

    async def run() -> None:
        counting = asyncio.create_task(count_rounds())
        await asyncio.gather(*(client(number) for number in range(20)))
        counting.cancel()

    asyncio.run(run())
    assert done == [5] * 20
    assert ahead <= 1 + AT_ONCE, "nobody is far ahead of the slowest"
    assert max(rounds.values()) <= 2 * AT_ONCE  # turns of a new round, and those that were left of the last


def test_one_client_alone_never_waits_for_long_and_a_cancelled_one_holds_nobody_up() -> None:
    turns = Turns()

    async def run() -> None:
        for _ in range(10):
            await asyncio.wait_for(turns.wait(), 5)
        waiting = [asyncio.create_task(turns.wait()) for _ in range(10)]
        for task in waiting[:-1]:
            task.cancel()
        await asyncio.wait_for(waiting[-1], 5)

    asyncio.run(run())

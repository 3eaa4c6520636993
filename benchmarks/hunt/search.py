"""Scenes drawn and evaluated until the time is over."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait

from benchmarks.hunt.families import FAMILIES
from benchmarks.hunt.scenes import Scene, draw_parameters

_BATCH = 4


def evaluate_seed(family: str, seed: int) -> Scene:
    """Draw and evaluate one scene."""
    chosen = FAMILIES[family]
    parameters = draw_parameters(chosen.bounds, seed)
    return Scene(seed, parameters, chosen.evaluate(parameters, seed))


def search(family: str, first_seed: int, *, minutes: float, processes: int, most: int | None = None) -> list[Scene]:
    """Evaluate scenes from a seed on until the time is over, or there are enough.

    Scenes that are under way when the time is over are still counted: otherwise slow scenes would be left out.
    """
    until = time.monotonic() + 60 * minutes
    found: list[Scene] = []
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        running: set[Future[list[Scene]]] = set()
        batches = _batches(first_seed, most)
        while True:
            while len(running) < 2 * processes and time.monotonic() < until:
                batch = next(batches, None)
                if batch is None:
                    break
                running.add(pool.submit(_evaluate, family, batch))
            if not running:
                return sorted(found, key=lambda scene: scene.seed)
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                found += future.result()


def _batches(first_seed: int, most: int | None) -> Iterator[list[int]]:
    seed, last = first_seed, None if most is None else first_seed + most
    while last is None or seed < last:
        end = seed + _BATCH if last is None else min(seed + _BATCH, last)
        yield list(range(seed, end))
        seed = end


def _evaluate(family: str, seeds: list[int]) -> list[Scene]:
    return [evaluate_seed(family, seed) for seed in seeds]

"""What is trained: coefficients in the code, each with the command that finds it again."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from itertools import pairwise

from app.values import Bools, Floats


def read_arguments(module: str, description: str | None, seed: int, option: str, count: int) -> tuple[int, int]:
    """Seed to learn from, the next one being for the test, and the number of `option` of each seed."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.training.{module}", description=description)
    parser.add_argument("--seed", type=int, default=seed, help="to learn from; the next one is for the test")
    parser.add_argument(f"--{option}", dest="count", type=int, default=count, help="of each seed and kind")
    arguments = parser.parse_args()
    return arguments.seed, arguments.count


def reliability_rows(probability: Floats, true: Bools, edges: Sequence[float]) -> Iterator[tuple[object, ...]]:
    """Predictions by their probability: range, number, mean probability, share that is true."""
    for low, high in pairwise(edges):
        inside = (probability >= low) & (probability < high)
        if inside.any():
            mean, share = probability[inside].mean(), true[inside].mean()
            yield f"{low:g} to {high:g}", int(inside.sum()), f"{mean:.4f}", f"{share:.4f}"

"""``python -m benchmarks.planning [ITEM ...] [--short]``: plans of whole roads.

Items: speed, predictions, optimiser, commit, papers, proofs, all. The exit status is 1 where a goal was missed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

from benchmarks.planning.commit import measure_commit
from benchmarks.planning.optimiser import measure_optimiser
from benchmarks.planning.papers import measure_papers
from benchmarks.planning.predictions import measure_predictions
from benchmarks.planning.proofs import measure_proofs
from benchmarks.planning.speed import measure_speed
from benchmarks.planning.tables import Section

RUNS: dict[str, Callable[[bool], Section]] = {
    "speed": measure_speed,
    "predictions": measure_predictions,
    "optimiser": measure_optimiser,
    "commit": measure_commit,
    "papers": measure_papers,
    "proofs": measure_proofs,
}


def main() -> int:
    """Print the tables; the exit status is 1 where a goal was missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.planning", description=__doc__)
    parser.add_argument("items", nargs="*", default=["all"])
    parser.add_argument("--short", action="store_true", help="small roads and few drives")
    arguments = parser.parse_args()
    unknown = set(arguments.items) - {*RUNS, "all"}
    if unknown:
        parser.error(f"no such item: {', '.join(sorted(unknown))}")
    start, met = time.monotonic(), True
    for item, run in RUNS.items():
        if "all" in arguments.items or item in arguments.items:
            section = run(arguments.short)
            met &= section.met
            print(f"\n{section}", flush=True)
    mode = "short mode" if arguments.short else "long mode"
    print(f"\n### planning-run\n\nGenerated roads of seed 13, {mode}; {time.monotonic() - start:.0f} s.")
    return 0 if met else 1


if __name__ == "__main__":
    raise SystemExit(main())

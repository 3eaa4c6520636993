"""``python -m benchmarks.cerpm [ITEM ...] [--short] [--seed N]``: print the tables.

Items: path, lanes, shape-errors, spoof, forged, dirty, tracking, routes, radio, europe, speed, physics, all.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Sequence

from benchmarks.cerpm.driven_lane import run_lanes
from benchmarks.cerpm.europe import run_europe
from benchmarks.cerpm.packets_and_steering import run_forged, run_radio, run_routes, run_speed, run_tracking
from benchmarks.cerpm.paths import Result, run_dirty, run_path, run_spoof
from benchmarks.cerpm.physics import run_physics
from benchmarks.cerpm.shape_errors import run_shape_errors

RUNS: dict[str, Callable[[int, bool], Result]] = {
    "path": run_path, "lanes": run_lanes, "shape-errors": run_shape_errors, "spoof": run_spoof, "forged": run_forged,
    "dirty": run_dirty,
    "tracking": run_tracking, "routes": run_routes, "radio": run_radio, "europe": run_europe, "speed": run_speed,
    "physics": run_physics,
}  # fmt: skip
ITEMS = tuple(RUNS)


def main() -> None:
    """Run the items."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cerpm", description=__doc__)
    parser.add_argument("items", nargs="*", default=["all"])
    parser.add_argument("--short", action="store_true", help="a few drives of everything")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    unknown = set(args.items) - {*RUNS, "all"}
    if unknown:
        parser.error(f"no such item: {', '.join(sorted(unknown))}")
    start = time.monotonic()
    for item, run in RUNS.items():
        if "all" in args.items or item in args.items:
            title, head, rows = run(args.seed, args.short)
            print(f"\n### cerpm-{item}\n\n{title}\n\n{table(head, rows)}", flush=True)
    mode = "short mode" if args.short else "long mode"
    print(f"\n### cerpm-run\n\nSeed {args.seed}, {mode}; {time.monotonic() - start:.0f} s.")


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Markdown table; the first column is text, the others are right-aligned."""
    lines = ["| " + " | ".join(head) + " |", "|" + "|".join(["---"] + ["--:"] * (len(head) - 1)) + "|"]
    return "\n".join(lines + ["| " + " | ".join(str(c) for c in row) + " |" for row in rows])


if __name__ == "__main__":
    main()

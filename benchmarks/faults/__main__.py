"""``python -m benchmarks.faults [--short] [--cycles N] [--only NAME]``: kills, failing disks, slow clients.

The exit status is 1 if anything acknowledged was lost or a goal was missed. strace and the right to mount a tmpfs are
needed for the failing disks; without them those rows say so.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

from benchmarks.faults.attack import attack
from benchmarks.faults.disks import failing_syncs, full_disk
from benchmarks.faults.kills import kill_cycles
from benchmarks.faults.rows import FaultRow, print_rows
from benchmarks.faults.times import measure_times


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.faults", description=__doc__)
    parser.add_argument("--short", action="store_true", help="a sample of everything, a minute on a quiet machine")
    parser.add_argument("--cycles", type=int, help="kills on each database; default: 100, short: 2")
    parser.add_argument("--seed", type=int, default=14)
    parser.add_argument("--only", choices=("sqlite", "postgresql", "syncs", "disk", "connections", "times"))
    arguments = parser.parse_args()
    short, seed = arguments.short, arguments.seed
    cycles = arguments.cycles or (2 if short else 100)
    parts: dict[str, Callable[[], list[FaultRow]]] = {
        "sqlite": lambda: kill_cycles("sqlite", cycles, seed),
        "postgresql": lambda: kill_cycles("postgresql", cycles, seed),
        "syncs": lambda: failing_syncs(range(1, 51, 10 if short else 1)),
        "disk": full_disk,
        "connections": lambda: attack(40 if short else 400),
        "times": lambda: measure_times(1 if short else 5),
    }
    rows = [row for name, measure in parts.items() if arguments.only in (None, name) for row in measure()]
    print_rows(rows, short=short)
    return 1 if any(row.met is False for row in rows) else 0


if __name__ == "__main__":
    raise SystemExit(main())

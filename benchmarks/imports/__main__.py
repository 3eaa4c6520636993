"""``python -m benchmarks.imports [--short] [--seed N] [--rows N]``: planted faults, clean surveys, rows a second."""

from __future__ import annotations

import argparse
import math
from collections import Counter, defaultdict

import numpy as np

from benchmarks.imports.faults import plant_faults
from benchmarks.imports.judge import STANDING, VERDICTS, Judge, open_judge
from benchmarks.imports.speed import print_speed
from benchmarks.imports.surveys import EVIDENCE, LANES, make_survey

GOAL = 0.98
_MUST_M = 10.0


def main() -> int:
    """Print the tables; the exit status is 1 where a goal was missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.imports", description=__doc__)
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--rows", type=int, help="Only the speed, with this many rows.")
    arguments = parser.parse_args()
    if arguments.rows:
        return 0 if print_speed(arguments.rows) else 1
    faults, clean, rows = (60, 20, 20_000) if arguments.short else (200, 120, 1_000_000)
    print(f"{'Short' if arguments.short else 'Long'} mode.\n")
    with open_judge() as judge:
        met = _print_faults(judge, arguments.seed, faults)
        met &= _print_clean(judge, arguments.seed + 1_000_000, clean)
    met &= print_speed(rows)
    return 0 if met else 1


def _print_faults(judge: Judge, seed: int, count: int) -> bool:
    found: dict[str, Counter[str]] = defaultdict(Counter)
    far: Counter[str] = Counter()
    for planted in plant_faults(seed, count):
        judged = judge.judge(planted)
        found[planted.kind][judged.verdict] += 1
        if not math.isnan(judged.moved_m) and judged.moved_m > _MUST_M:
            far[judged.verdict] += 1
    total: Counter[str] = sum(found.values(), Counter())
    print(
        f"### imports-faults\n\n{count} planted faults, seed {seed}. A standing caution is a warning that clean "
        "surveys get too.\n"
    )
    print(f"| fault | planted | {' | '.join(VERDICTS)} |\n|---|---|{'---|' * len(VERDICTS)}")
    for kind, verdicts in found.items():
        print(f"| {kind} | {verdicts.total()} | {' | '.join(str(verdicts[v]) for v in VERDICTS)} |")
    print(f"| **all** | {count} | {' | '.join(str(total[v]) for v in VERDICTS)} |")
    print(f"| moves a marker over 10 m | {far.total()} | {' | '.join(str(far[v]) for v in VERDICTS)} |")
    detected = 1 - total["missed"] / count
    named = (total["refused"] + total["warned"]) / count
    print(
        f"\n{named:.1%} were refused or warned about by a check for that fault; together with those that got only a "
        f"standing caution, {detected:.1%} (goal {GOAL:.0%}).\n"
    )
    return detected >= GOAL and not far["missed"]


def _print_clean(judge: Judge, seed: int, count: int) -> bool:
    rng = np.random.default_rng(seed)
    refused = alarmed = standing = warnings = 0
    for k in range(count):
        survey = make_survey(rng, LANES[k % len(LANES)], EVIDENCE[k // len(LANES) % len(EVIDENCE)])
        is_refused, codes = judge.codes(judge.caller(survey), survey.csv(), survey.declaration)
        own = sum(n for code, n in codes.items() if code not in STANDING)
        refused += is_refused
        alarmed += own > 0
        warnings += own
        standing += any(code in STANDING for code in codes)
    print("### imports-clean\n")
    print(
        "| surveys | refused | with a false warning | false warnings | with a standing caution |\n|---|---|---|---|---|"
    )
    print(f"| {count} | {refused} | {alarmed} | {warnings} | {standing} |\n")
    return refused == 0


if __name__ == "__main__":
    raise SystemExit(main())

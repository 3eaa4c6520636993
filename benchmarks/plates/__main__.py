"""``python -m benchmarks.plates [ITEM ...] [--short] [--seed N] [--seeds M]``: print the tables.

Items: trials, height, false, peers, speed, accuracy, light, reliability, schemes, thermal, print, all. The long
mode takes three seeds, the short one a part of the frames of one seed, which its tables scale up.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor

from benchmarks.plates import tables
from benchmarks.plates.evaluate import Record, evaluate_job
from benchmarks.plates.prints import print_records, prints_table
from benchmarks.plates.schemes import (
    SCHEME_SETS,
    SchemeDrive,
    evaluate_drive,
    list_drives,
    schemes_table,
    wrong_readings,
)
from benchmarks.plates.sets import LIGHT, MIN_ROWS, RENDERED_ROWS, SETS, THERMAL_KMH, WITHOUT_PLATE, Job, read_trials
from benchmarks.plates.speed import measure_speed
from benchmarks.plates.thermal import ThermalDrive, evaluate_thermal, thermal_table

ITEMS = (
    "trials",
    "height",
    "false",
    "peers",
    "speed",
    "accuracy",
    "light",
    "reliability",
    "schemes",
    "thermal",
    "print",
)
NEEDS = {
    "trials": ("trial",),
    "height": ("trial", "stress", "night", *THERMAL_KMH, "hidden"),
    "false": SETS,
    "peers": ("trial", "stress"),
    "accuracy": ("trial",),
    "light": LIGHT,
    "reliability": (*LIGHT, "stress"),
}
ALL_SETS = tuple(dict.fromkeys([*SETS, *SCHEME_SETS]))
BATCH = 25
# frames (drives for thermal) a seed: long, short
COUNTS = {
    "stress": (400, 24), "night": (50, 6), "hidden": (100, 10), **dict.fromkeys(WITHOUT_PLATE, (1000, 40)),
    **dict.fromkeys(THERMAL_KMH, (12, 1)), **dict.fromkeys(LIGHT, (150, 10)),
}  # fmt: skip
SCHEME_DRIVES = (5, 1)  # of each set and seed: long, short
THERMAL_DRIVES = (18, 2)  # of each seed: long, short
SHORT_SHARE = 0.08
MISSED_ROWS = 16


def list_jobs(items: set[str], seeds: list[int], *, short: bool, only: Sequence[str] = SETS) -> list[Job]:
    """Everything that the items need to see, of the sets in ``only``, the longest first."""
    sets = {name for item in items for name in NEEDS.get(item, ()) if name in only}
    jobs = []
    for seed in seeds:
        for name in sets:
            peers = any(item in items and name in NEEDS[item] for item in ("peers", "light"))
            if name == "trial":
                share = SHORT_SHARE if short else 1.0
                jobs += [Job(name, k, seed, 0, share, peers) for k in range(len(read_trials()))]
                continue
            count = COUNTS[name][short]
            if name in THERMAL_KMH:
                jobs += [Job(name, k, seed, 0) for k in range(count)]
            else:
                sizes = [min(BATCH, count - start) for start in range(0, count, BATCH)]
                jobs += [Job(name, k, seed, size, peers=peers) for k, size in enumerate(sizes)]
    order = {(10, 1): 2, (12, 1): 2, (13, 1): 0, (13, 2): 1}
    trials = read_trials()
    return sorted(
        jobs,
        key=lambda j: (
            order.get((trials[j.index].figure, trials[j.index].trial), 3) if j.set_name == "trial" else 3,
            j.set_name, j.seed, j.index,
        ),
    )  # fmt: skip


def run_jobs(jobs: list[Job], processes: int) -> list[Record]:
    """Records of all jobs."""
    if not jobs:
        return []
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        return [record for records in pool.map(evaluate_job, jobs) for record in records]


def main() -> None:
    """Run the items asked for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.plates", description=__doc__)
    parser.add_argument("items", nargs="*", choices=[*ITEMS, "all"], default="all")
    parser.add_argument("--short", action="store_true", help="a part of the frames of one seed, under a minute")
    parser.add_argument("--seed", type=int, default=1, help="first seed")
    parser.add_argument("--seeds", type=int, default=3, help="how many seeds the long mode takes")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--sets", nargs="+", choices=ALL_SETS, default=ALL_SETS, help="leave the other sets out")
    parser.add_argument("--misses", action="store_true", help="name the frames that were not decoded")
    args = parser.parse_args()
    items = set(ITEMS) if "all" in args.items else set(args.items)
    seeds = [args.seed + k for k in range(1 if args.short else args.seeds)]
    start = time.monotonic()
    timings, stages = measure_speed(args.seed, 12 if args.short else 100) if "speed" in items else ([], [])
    records = run_jobs(list_jobs(items, seeds, short=args.short, only=args.sets), args.processes)
    print(f"Seeds {', '.join(map(str, seeds))}; {len(records)} frames evaluated; {time.monotonic() - start:.0f} s.")
    if args.short:
        print(f"Short mode: {SHORT_SHARE:.0%} of the trials' frames, drawn at random; their counts are scaled up.")
    _print("trials", items, tables.trials_table, records, _TRIALS_NOTE)
    _print("height", items, tables.height_table, records, "Decode rate by the height of the plate's image.")
    _print("false", items, tables.wrong_table, records, "Wrong digits that were returned as valid.")
    _print("peers", items, tables.peers_table, records, _PEERS_NOTE)
    if timings:
        print(f"\n### speed\n\n{_SPEED_NOTE}\n\n{tables.speed_table(timings)}")
        print(f"\n{_STAGES_NOTE}\n\n{tables.stages_table(stages)}")
    _print("accuracy", items, tables.accuracy_table, records, _ACCURACY_NOTE)
    _print("light", items, tables.light_table, records, _LIGHT_NOTE)
    _print("reliability", items, tables.reliability_table, records, _RELIABILITY_NOTE)
    if "print" in items:
        how = {"passes": 1, "step_of_strengths": 3} if args.short else {}
        prints = [record for seed in seeds for record in print_records(seed, **how)]
        print(f"\n### print\n\n{_PRINT_NOTE}\n\n{prints_table(prints)}")
    if "schemes" in items:
        _print_schemes(list_drives(seeds, SCHEME_DRIVES[args.short], args.sets), args.processes)
    if "thermal" in items:
        thermal_drives = [ThermalDrive(seed, k) for seed in seeds for k in range(THERMAL_DRIVES[args.short])]
        with ProcessPoolExecutor(args.processes, mp_context=multiprocessing.get_context("spawn")) as pool:
            found = [record for records in pool.map(evaluate_thermal, thermal_drives) for record in records]
        print(f"\n### thermal\n\n{_THERMAL_NOTE}\n\n{thermal_table(found)}")
    if wrong := tables.frame_list(r for r in records if r.wrong or r.wrong_known):
        print(f"\nWrong digits:\n{wrong}")
    if args.misses:
        missed = (r for r in records if r.height_px >= MISSED_ROWS and not r.decoded)
        print(f"\nNot decoded at {MISSED_ROWS} rows and more:\n{tables.frame_list(missed)}")


_TRIALS_NOTE = (
    "Frames per drive, mean over the seeds. A plate is in view if all its corners are inside the frame and it is at "
    f"least {MIN_ROWS:g} rows high. Frames in which it has fewer than {RENDERED_ROWS:g} rows are not processed and "
    "count as not decoded. Every seed must meet the goal, so 'minimum' is compared with it. "
    "'Algorithm 1' is the paper's own algorithm (`frames.method` = `paper`) on the same frames, in the boxes of our "
    "candidates; 'paper' is what the paper reports of its road. 'Decoded' counts all digits, with a check or without."
)
_PEERS_NOTE = (
    'The same scenes with a tag that has the plate\'s footprint; default parameters, one thread. The columns "plate" '
    'and "peer\'s tag" count decoded frames.'
)


_ACCURACY_NOTE = (
    "Errors over the frames that were decoded in the trials without a registry. The table by rows has rolling "
    'shutters compensated. "At the limit" is the error that would remain if the corners had only the errors that '
    'follow from independent residuals of the pixels. "Within 2 sigma" is the share of errors along the plate\'s axes '
    "that are below two reported standard deviations (95.4 % for a normal distribution)."
)
_SPEED_NOTE = "Processor time, not wall time. The decoders take turns on each frame."
_STAGES_NOTE = "Mean milliseconds of each stage of the decoder, in a second run of the same frames."


_LIGHT_NOTE = (
    "Drives of five frames in which the plate has 12 to 90 rows, on a fair day with one disturbance each; position "
    "plates without check digits. Stains are one to three ellipses of paint with half axes of 8 to 30 mm. The last two "
    "columns count tags with the plate's footprint in the same scenes. A drive is lost if none of its frames is read."
)
_PRINT_NOTE = (
    "Print grades of photos of plates with one fault each, and the frames in which the same plates are read, with a "
    "registry and alone (without one), in simulated passes by day at 60 km/h. Values are medians over the seeds; the "
    "grades are all those that occurred."
)


_RELIABILITY_NOTE = (
    "Readings without a registry: their mean confidence, and the share that is right. In the stained sets every plate "
    "is stained, while the decoder assumes that one in fifty is."
)


_THERMAL_NOTE = (
    "Frames of a thermal camera of 640 x 512 pixels, one in each interval of heights of a drive at 10, 20 or 30 km/h, "
    "and colour frames of the same size from the same places on a fair day. In every other three drives the plate is "
    "colder than the road. Frames without a plate have up to three warm or cold things that are none."
)


_SCHEMES_NOTE = (
    "Drives of five frames in which the plate has 12 to 90 rows, as in the previous table of disturbances; in the set "
    '"stress", five frames of 24 to 140 rows. Plates and tags are all 325 mm wide, lie in the same place and have the '
    "same stains. The registry has twenty plates within 500 m. A drive is lost if none of its frames is read; the "
    "worst drive is the one with the fewest frames read."
)


def _print_schemes(drives: list[SchemeDrive], processes: int) -> None:
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        records = [record for found in pool.map(evaluate_drive, drives) for record in found]
    print(f"\n### schemes\n\n{_SCHEMES_NOTE}\n\n{schemes_table(records)}")
    for wrong in wrong_readings(records):
        print(f"\nWrong: {wrong}")


def _print(
    item: str, items: set[str], make: Callable[[Sequence[Record]], str], records: list[Record], note: str
) -> None:
    if item in items:
        print(f"\n### {item}\n\n{note}\n\n{make(records)}")


if __name__ == "__main__":
    main()

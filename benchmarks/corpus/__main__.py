"""``python -m benchmarks.corpus [--raise] [GROUP ...]``: read the recordings, and print the counts beside the minima.

The exit status is 1 where a promise is broken. ``--raise`` raises the minima to what is read now, and never lowers one.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping

import cv2

from benchmarks.corpus.counts import Counts
from benchmarks.corpus.groups import VERSIONS, broken, list_groups, raise_promises, read_group, read_promises


def main() -> int:
    """Read, print, and raise if asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.corpus", description=__doc__)
    parser.add_argument("groups", nargs="*", metavar="GROUP", help="beginnings of names; all, if none is named")
    parser.add_argument("--raise", action="store_true", dest="raised", help="raise the minima to what is read now")
    chosen = parser.parse_args()
    cv2.setNumThreads(1)
    began_s, found = time.process_time(), dict[str, Counts]()
    for group in list_groups():
        if not chosen.groups or group.startswith(tuple(chosen.groups)):
            found[group] = read_group(group)
    spent_s = time.process_time() - began_s
    kept = _print(found)
    print(f"\n{', '.join(VERSIONS.values())}; {spent_s:.0f} s of one core.")
    if chosen.raised:
        raise_promises(found)
    return 0 if kept or chosen.raised else 1


def _print(found: Mapping[str, Counts]) -> bool:
    """The table; whether all promises are kept."""
    promises, faults = read_promises(), []
    print("### corpus\n\n| group | read as | possible | least | read | wrong |\n|---|---|--:|--:|--:|--:|")
    for group, counts in found.items():
        for way, count in counts.items():
            promise = promises.get(group, {}).get(way)
            least = "-" if promise is None else promise.least
            more = f" of {promise.known_wrong} known" if promise is not None and promise.known_wrong else ""
            print(f"| {group} | {way} | {count.possible} | {least} | {count.read} | {len(count.wrong)}{more} |")
            if promise is not None and (fault := broken(promise, count)):
                faults.append(f"- {group}, {way}: {fault}")
    print("\nAll promises are kept." if not faults else "\nBroken promises:\n\n" + "\n".join(faults))
    return not faults


if __name__ == "__main__":
    raise SystemExit(main())

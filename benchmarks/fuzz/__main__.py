"""``python -m benchmarks.fuzz [ITEM ...] [--seconds N] [--short]``: print what was tried and what survived.

Items: the names of parsers, `parsers` for all of them; the names of grammars, `grammar` for valid files of all of them,
whose content is compared; `frames` for damaged pictures in the decoder processes, `registry` for the registry beside a
model. The exit status is 1 where something failed; its smallest input is printed.
"""

from __future__ import annotations

import argparse

from benchmarks.fuzz.frames import attack_frames
from benchmarks.fuzz.grammar import compare, list_grammars
from benchmarks.fuzz.parsers import attack, list_parsers
from benchmarks.fuzz.registry_model import compare_with_model


def main() -> int:
    """Run the items; 1 where one failed."""
    parsers = {parser.name: parser for parser in list_parsers()}
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz", description=__doc__)
    parser.add_argument("items", nargs="*", default=["parsers", "grammar", "frames", "registry"])
    parser.add_argument("--files", type=int, default=10_000, help="of each grammar")
    parser.add_argument("--seed", type=int, default=1, help="of the grammars: other files")
    parser.add_argument("--seconds", type=float, default=600.0, help="for each parser")
    parser.add_argument("--mutations", type=int, default=100_000, help="of pictures")
    parser.add_argument("--runs", type=int, default=2000, help="of the registry, of 50 steps each, on each database")
    parser.add_argument("--short", action="store_true", help="two seconds for each parser, 500 pictures, 10 runs")
    args = parser.parse_args()
    if args.short:
        args.seconds, args.mutations, args.runs, args.files = 2.0, 500, 10, 100
    failures: list[str] = []
    print(f"### fuzz\n\n{'Short' if args.short else 'Long'} mode.\n")
    print("| input | tried | accepted | refused | slowest [CPU s] | failed |\n|---|--:|--:|--:|--:|--:|")
    for name, one in parsers.items():
        if name in args.items or "parsers" in args.items:
            found = attack(one, seconds=args.seconds)
            _print(name, found.tried, found.accepted, found.refused.total(), found.slowest_s, found.failures)
            failures += found.failures
    for name in list_grammars():
        if name not in args.items and "grammar" not in args.items:
            continue
        compared = compare(name, args.files, args.seed)
        read = compared.tried - compared.refused
        _print(f"{name}, valid", compared.tried, read, compared.refused, 0.0, compared.failures)
        failures += compared.failures
    if "frames" in args.items:
        pictures = attack_frames(args.mutations)
        refused = pictures.refused.total()
        _print("pictures", pictures.tried, pictures.accepted, refused, pictures.slowest_s, pictures.failures)
        failures += pictures.failures
    if "registry" in args.items:
        for kind, found_failures in compare_with_model(args.runs):
            _print(f"registry, {kind}", args.runs, args.runs - len(found_failures), 0, 0.0, found_failures)
            failures += found_failures
    for failure in failures:
        print(f"\n{failure}")
    return 1 if failures else 0


def _print(name: str, tried: int, accepted: int, refused: int, slowest_s: float, failures: list[str]) -> None:
    print(f"| {name} | {tried} | {accepted} | {refused} | {slowest_s:.2f} | {len(failures)} |", flush=True)


if __name__ == "__main__":
    raise SystemExit(main())

"""``python -m benchmarks.planning.fit [--passes N] [--only NAME]``: drive, fit the models, write their parameters.

It writes app/planning/data/predictions.json. With 120 passes a condition it takes about ten minutes on one core.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import orjson

from app.planning.proof.report import Condition
from benchmarks.planning.fit.fit import NIGHT_EXPOSURES_S, fit_lines, fit_path, fit_plates, fit_tags
from benchmarks.planning.fit.observe import FIRST_SEED, line_drives, path_drives, plate_passes, tag_passes

FILE = Path(__file__).resolve().parents[3] / "app/planning/data/predictions.json"
_T = TypeVar("_T")


def main() -> None:
    """Fit the models and write the file."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.planning.fit", description=__doc__)
    parser.add_argument("--passes", type=int, default=120, help="over plates in each condition; others in proportion")
    parser.add_argument("--only", choices=tuple(FITS), help="fit this alone, and keep the other parameters")
    arguments = parser.parse_args()
    count = arguments.passes
    document = orjson.loads(FILE.read_bytes()) if arguments.only else {}
    document["source"] = (
        f"python -m benchmarks.planning.fit --passes {count}: simulated drives on generated roads of the seeds from "
        f"{FIRST_SEED}; {count} passes over plates in each condition, twice as many by night, {2 * count} over tags, "
        f"{count} drives along lines, {2 * count} past CERPMs in two stretches each"
    )
    for name, fit in FITS.items():
        if arguments.only in (None, name):
            document[name] = fit(count)
    FILE.write_bytes(orjson.dumps(document, option=orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE))
    print(f"Written to {FILE}")


def _fit_plates(count: int) -> dict[str, Any]:
    found = {}
    for condition in Condition:
        night = condition is Condition.NIGHT  # blur decides there, and only some of the passes are near its limit
        seen = list(_shown(f"plates, {condition}", plate_passes(condition, (2 if night else 1) * count, FIRST_SEED)))
        exposures = NIGHT_EXPOSURES_S if night else ()
        found[str(condition)] = asdict(fit_plates(seen, exposures))
    return found


def _fit_tags(count: int) -> dict[str, Any]:
    return asdict(fit_tags(list(_shown("tags", tag_passes(2 * count, FIRST_SEED + 1000)))))


def _fit_lines(count: int) -> dict[str, Any]:
    return asdict(fit_lines(list(_shown("lines", line_drives(count, FIRST_SEED + 2000)))))


def _fit_path(count: int) -> dict[str, Any]:
    return asdict(fit_path(list(_shown("paths", path_drives(2 * count, FIRST_SEED + 3000)))))


FITS: dict[str, Callable[[int], dict[str, Any]]] = {
    "plates": _fit_plates,
    "tags": _fit_tags,
    "lines": _fit_lines,
    "path": _fit_path,
}


def _shown(what: str, seen: Iterable[_T]) -> Iterator[_T]:
    found = 0
    for one in seen:
        found += 1
        yield one
    print(f"{what}: {found}", flush=True)


if __name__ == "__main__":
    main()

"""``python -m benchmarks.registry [--short | --rows N] [--growth N,N,...]``: the registry at size.

Short mode has 20,000 rows and a second for each figure; otherwise a million. The exit status is 1 where a goal was
missed.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from app.registry.database import Database
from benchmarks.registry.fill import Network, fill, lay_roads
from benchmarks.registry.searches import measure_growth, measure_searches
from benchmarks.registry.servers import drop_database, make_database, settle
from benchmarks.registry.serving import measure_boxes, measure_tiles
from benchmarks.registry.verification import VERSIONS, measure_verification

OUT = Path("bench-out/registry")
GROWTH = (10_000, 100_000, 1_000_000, 5_000_000)


@dataclass(frozen=True)
class Filled:
    """The same markers in both databases."""

    network: Network
    urls: dict[str, str]
    keys: dict[str, str]


def main() -> int:
    """Print the tables; the exit status is 1 where a goal was missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.registry", description=__doc__)
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--rows", type=int, default=None)
    parser.add_argument("--growth", type=_numbers, default=None, help="rows of the growth table, e.g. 10000,5000000")
    parser.add_argument("--only", choices=("http", "searches", "growth", "audit"), default=None)
    arguments = parser.parse_args()
    rows = arguments.rows or (20_000 if arguments.short else 1_000_000)
    seconds = 1.0 if arguments.short else 4.0
    met, known = True, {}
    if arguments.only in (None, "audit"):
        with filled(rows // VERSIONS) as registry:
            met &= measure_verification(registry)
    if arguments.only not in ("growth", "audit"):
        with filled(rows) as registry:
            if arguments.only != "searches":
                met &= measure_boxes(registry, OUT / "tipg", seconds)
                met &= measure_tiles(registry, OUT / "tipg", seconds)
            if arguments.only != "http":
                good, known[rows] = measure_searches(registry)
                met &= good
    if arguments.only in (None, "growth"):
        sizes = arguments.growth or ((2_000, 20_000) if arguments.short else GROWTH)
        met &= measure_growth(sizes, filled, known)
    return 0 if met else 1


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split(","))


@contextlib.contextmanager
def filled(rows: int) -> Iterator[Filled]:
    """Both databases with so many markers, dropped afterwards."""
    network, name = lay_roads(rows), f"waymark_bench_{rows}"
    folder = Path(tempfile.mkdtemp(prefix="waymark-bench-registry-"))
    try:
        urls = {"PostgreSQL": make_database(name), "SQLite": f"sqlite:///{folder / 'waymark.sqlite3'}"}
        keys = {}
        for kind, url in urls.items():
            database = Database(url)
            database.open()
            database.migrate()
            keys[kind] = fill(database, network)
            database.close()
        settle(urls["PostgreSQL"])
        yield Filled(network, urls, keys)
    finally:
        shutil.rmtree(folder)
        drop_database(name)


if __name__ == "__main__":
    raise SystemExit(main())

"""``python -m benchmarks.registry.rtree [--rows N] [--imports]``: three ways to fill the R*Tree of an SQLite file.

Packed nodes (`app.registry.spatial`), one INSERT in the order of the rows, one INSERT in the order of packing. With
``--imports`` whole imports of as many rows are measured too, each in a process of its own.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import numpy as np
import sqlalchemy as sa

from app.registry import bulk_load
from app.registry.spatial import fill_rtree
from app.values import Floats

_COLUMNS = "row, lon_deg, lon_deg, lat_deg, lat_deg"
_QUERIES = 2_000
_HALF_DEG = 0.02


def _insert(connection: sa.Connection, table: str) -> None:
    connection.exec_driver_sql(f"INSERT INTO {table}_rtree SELECT {_COLUMNS} FROM {table}")


def _insert_sorted(connection: sa.Connection, table: str) -> None:
    rows = connection.exec_driver_sql(f"SELECT count(*) FROM {table}").scalar_one()
    slices = max(math.ceil(math.sqrt(rows / 51)), 1)
    numbered = f"SELECT *, ntile({slices}) OVER (ORDER BY lon_deg) AS slice FROM {table}"
    connection.exec_driver_sql(f"INSERT INTO {table}_rtree SELECT {_COLUMNS} FROM ({numbered}) ORDER BY slice, lat_deg")


WAYS: dict[str, Callable[[sa.Connection, str], None]] = {
    "packed": fill_rtree,
    "INSERT in row order": _insert,
    "INSERT, sorted": _insert_sorted,
}


def _grid(rows: int, _rng: np.random.Generator) -> Floats:
    side = math.isqrt(rows) + 1
    k = np.arange(rows)
    return np.column_stack([8 + k % side * 2e-4, 49 + k // side * 2e-4])


def _road(rows: int, rng: np.random.Generator) -> Floats:
    heading = np.cumsum(rng.normal(0, 0.05, rows))
    return np.column_stack([8 + np.cumsum(np.cos(heading)) * 2e-4 % 5, 49 + np.cumsum(np.sin(heading)) * 2e-4 % 5])


def _scattered(rows: int, rng: np.random.Generator) -> Floats:
    return np.column_stack([rng.uniform(6, 11, rows), rng.uniform(46, 51, rows)])


LAYOUTS = {"grid": _grid, "along a road": _road, "scattered": _scattered}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.registry.rtree", description=__doc__)
    parser.add_argument("--rows", type=int, default=300_000)
    parser.add_argument("--imports", action="store_true")
    parser.add_argument("--way", choices=WAYS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.way:
        _import(arguments.way, arguments.rows)
        return
    print(f"{arguments.rows} points\n\n| points | way | s | CPU s | nodes | file [MB] | query [µs] |")
    print("|---|---|---|---|---|---|---|")
    for layout, make in LAYOUTS.items():
        points = make(arguments.rows, np.random.default_rng(1))
        for way in WAYS:
            print(f"| {layout} | {way} | {_measure(points, way)} |", flush=True)
    if arguments.imports:
        print(
            "\n| whole import, R*Tree by | s | CPU s | of it the R*Tree | file [MB] |\n|---|---|---|---|---|",
            flush=True,
        )
        for way in WAYS:
            module = [sys.executable, "-m", "benchmarks.registry.rtree"]
            subprocess.run([*module, "--rows", str(arguments.rows), "--way", way], check=True)


def _measure(points: Floats, way: str) -> str:
    with TemporaryDirectory(prefix="waymark-bench-rtree-") as folder:
        path = Path(folder) / "points.sqlite3"
        engine = sa.create_engine(f"sqlite:///{path}")
        with engine.connect() as connection:
            for pragma in ("page_size = 16384", "journal_mode = WAL", "synchronous = FULL", "cache_size = -32768"):
                connection.exec_driver_sql(f"PRAGMA {pragma}")
            connection.commit()
            connection.exec_driver_sql("CREATE TABLE markers (row INTEGER PRIMARY KEY, lon_deg REAL, lat_deg REAL)")
            connection.exec_driver_sql(
                "CREATE VIRTUAL TABLE markers_rtree USING rtree(row, min_lon, max_lon, min_lat, max_lat)"
            )
            connection.exec_driver_sql(
                "INSERT INTO markers (lon_deg, lat_deg) VALUES (?, ?)", list(map(tuple, points.tolist()))
            )
            connection.commit()
            began, cpu_began = time.perf_counter(), time.process_time()
            WAYS[way](connection, "markers")
            connection.commit()
            took = f"{time.perf_counter() - began:.1f} | {time.process_time() - cpu_began:.1f}"
            nodes = connection.exec_driver_sql("SELECT count(*) FROM markers_rtree_node").scalar_one()
            connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")
            query_us = _query_us(connection, points)
        engine.dispose()
        return f"{took} | {nodes} | {path.stat().st_size / 1e6:.1f} | {query_us:.0f}"


def _query_us(connection: sa.Connection, points: Floats) -> float:
    """Mean CPU time of counting the points in a box around one of them, the best of three rounds. [µs]"""
    cursor = connection.connection.driver_connection
    assert cursor is not None
    query = "SELECT count(*) FROM markers_rtree WHERE max_lon>=? AND min_lon<=? AND max_lat>=? AND min_lat<=?"
    at = points[np.random.default_rng(2).integers(0, len(points), _QUERIES)].tolist()
    rounds = []
    for _ in range(3):
        began = time.process_time()
        for lon, lat in at:
            cursor.execute(query, (lon - _HALF_DEG, lon + _HALF_DEG, lat - _HALF_DEG, lat + _HALF_DEG)).fetchone()
        rounds.append(time.process_time() - began)
    return 1e6 * min(rounds) / _QUERIES


def _import(way: str, rows: int) -> None:
    """One import in this process, with the R*Tree filled in one of the ways."""
    from app.families.surveys import MarkerRules
    from app.formats.format import SpooledFile
    from app.registry.database import Database
    from app.registry.engines import across_agencies
    from app.services.access.access import Access, Scope
    from app.services.decoder_tasks import SameProcess
    from app.services.surveys.import_report import DeclarationIn, import_input
    from app.services.surveys.imports import Imports
    from benchmarks.imports.judge import now
    from benchmarks.imports.speed import write_survey

    tree_s = []

    def fill(connection: sa.Connection, table: str) -> None:
        began = time.process_time()
        WAYS[way](connection, table)
        tree_s.append(time.process_time() - began)

    with TemporaryDirectory(prefix="waymark-bench-rtree-") as folder, across_agencies():
        survey, path = Path(folder) / "survey.csv", Path(folder) / "registry.sqlite3"
        write_survey(survey, rows)
        database = Database(f"sqlite:///{path}")
        database.open()
        database.migrate()
        access = Access(database, now)
        caller = access.authenticate(access.create_key("bench", Scope.PLANNER, "bench"))
        declaration = DeclarationIn(
            crs="EPSG:4326", vertical_datum="ellipsoid", family="cerpm", columns={"code": "number"}
        )
        given = import_input(declaration, SpooledFile.at(survey))
        with mock.patch.object(bulk_load, "fill_rtree", fill):
            began, cpu_began = time.perf_counter(), time.process_time()
            Imports(database, now, SameProcess(), MarkerRules()).run(caller, given)
            took = f"{time.perf_counter() - began:.1f} | {time.process_time() - cpu_began:.1f}"
        database.close()
        print(f"| {way} | {took} | {sum(tree_s):.1f} | {path.stat().st_size / 1e6:.0f} |", flush=True)


if __name__ == "__main__":
    main()

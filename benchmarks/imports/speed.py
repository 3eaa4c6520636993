"""Rows a second and memory: a survey into an empty registry and out again, beside GDAL with the same file.

Every run is a process of its own, so that its peak of memory is its own.
"""

from __future__ import annotations

import math
import os
import resource
import secrets
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import orjson
import sqlalchemy as sa

SERVER = os.environ.get("WAYMARK_TEST_POSTGRES_URL", "postgresql+psycopg://postgres@127.0.0.1:5432/postgres")
BOX_DEG = (8.0, 49.0)
_STEP_DEG = 2e-4
GOAL_S, GOAL_MIB = 60.0, 500.0


@dataclass(frozen=True)
class Figure:
    """What one step took."""

    what: str
    seconds: float
    cpu_s: float
    mib: float


def print_speed(rows: int) -> bool:
    """The table; whether imports and the GeoPackage keep the goals, which are for a million rows."""
    with TemporaryDirectory(prefix="waymark-bench-imports-") as name:
        survey = Path(name) / "survey.csv"
        write_survey(survey, rows)
        print(f"### imports-speed\n\n{rows} rows, {survey.stat().st_size / 1e6:.0f} MB of CSV.\n")
        print("| step | s | rows/s | CPU s | peak memory [MiB] |\n|---|---|---|---|---|", flush=True)
        figures = []
        for figure in _figures(survey, Path(name)):
            figures.append(figure)
            rate = f"{figure.seconds:.1f} | {rows / figure.seconds:.0f} | {figure.cpu_s:.1f}"
            print(f"| {figure.what} | {rate} | {figure.mib:.0f} |", flush=True)
    limit_s = GOAL_S * max(rows / 1_000_000, 0.1)
    kept = all(f.seconds <= limit_s for f in figures if f.what.startswith(("import", "gpkg")))
    kept &= all(f.mib <= GOAL_MIB for f in figures if f.what.startswith(("import", "geojson")))
    print(f"\nGoals (a million: {GOAL_S:.0f} s, {GOAL_MIB:.0f} MiB): {'kept' if kept else 'missed'}.\n")
    return kept


def _figures(survey: Path, folder: Path) -> Iterator[Figure]:
    for database in ("SQLite", "PostgreSQL"):
        with _database(database, folder) as url:
            for step in ("import", "gpkg", "geojson") if url is not None else ():
                made = _run_step(step, url or "", survey, folder / f"{database}-{step}")
                yield Figure(f"{step} {'into' if step == 'import' else 'from'} {database}", **made)
    yield from _peers(survey, folder)


def write_survey(path: Path, rows: int) -> None:
    """A survey of a grid of markers, in CSV."""
    side = math.isqrt(rows) + 1
    with path.open("w") as file:
        file.write("number,lon,lat,height\n")
        for k in range(rows):
            lon, lat = BOX_DEG[0] + k % side * _STEP_DEG, BOX_DEG[1] + k // side * _STEP_DEG
            file.write(f"{k + 1},{lon + 1e-9:.9f},{lat + 1e-9:.9f},{120 + k % 7 / 10:.3f}\n")


@contextmanager
def _database(kind: str, folder: Path) -> Iterator[str | None]:
    if kind == "SQLite":
        yield f"sqlite:///{folder / 'registry.sqlite3'}"
        return
    with _postgres() as url:
        yield url


@contextmanager
def _postgres() -> Iterator[str | None]:
    server = sa.create_engine(SERVER, isolation_level="AUTOCOMMIT", poolclass=sa.NullPool)
    name = f"waymark_bench_{secrets.token_hex(4)}"
    try:
        with server.connect() as connection:
            connection.exec_driver_sql(f"CREATE DATABASE {name} TEMPLATE template0 ENCODING 'UTF8'")
    except sa.exc.OperationalError:
        yield None
        return
    try:
        url = sa.make_url(SERVER).set(database=name)
        engine = sa.create_engine(url, isolation_level="AUTOCOMMIT", poolclass=sa.NullPool)
        with engine.connect() as connection:
            connection.exec_driver_sql("CREATE EXTENSION postgis")
        yield url.render_as_string(hide_password=False)
    finally:
        with server.connect() as connection:
            connection.exec_driver_sql(f"DROP DATABASE {name} WITH (FORCE)")


def _run_step(step: str, url: str, survey: Path, out: Path) -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.imports.speed", step, url, str(survey), str(out)]
    answer = subprocess.run(command, check=True, capture_output=True)
    document: dict[str, Any] = orjson.loads(answer.stdout.splitlines()[-1])
    return document


def _peers(survey: Path, folder: Path) -> list[Figure]:
    """GDAL loads the same points and nothing more: no checks, no codes, no history."""
    layer = ["-oo", "X_POSSIBLE_NAMES=lon", "-oo", "Y_POSSIBLE_NAMES=lat", "-a_srs", "EPSG:4326", "-nln", "markers"]
    found = [
        _measured(
            "ogr2ogr CSV to GeoPackage", ["ogr2ogr", "-f", "GPKG", *layer, str(folder / "peer.gpkg"), str(survey)]
        )
    ]
    with _postgres() as url:
        if url is not None:
            at = sa.make_url(url)
            target = f"PG:host={at.host} port={at.port or 5432} dbname={at.database} user={at.username or 'postgres'}"
            command = ["ogr2ogr", "-f", "PostgreSQL", *layer, "--config", "PG_USE_COPY", "YES", target, str(survey)]
            found.append(_measured("ogr2ogr CSV to PostGIS", command))
    return [figure for figure in found if figure is not None]


def _measured(what: str, command: list[str]) -> Figure | None:
    began = time.perf_counter()
    try:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except FileNotFoundError:
        return None
    _pid, status, used = os.wait4(process.pid, 0)
    process.returncode = status
    if status:
        return None
    return Figure(what, time.perf_counter() - began, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


def main() -> None:
    """One step in this process; its figures as JSON."""
    from app.families.surveys import MarkerRules
    from app.formats.format import SpooledFile
    from app.registry.database import Database
    from app.registry.markers import MarkerFilter
    from app.services.access.access import Access, Scope
    from app.services.decoder_tasks import SameProcess
    from app.services.surveys.exports import Exports
    from app.services.surveys.import_report import DeclarationIn, import_input
    from app.services.surveys.imports import Imports
    from benchmarks.imports.judge import now

    step, url, survey, out = sys.argv[1:]
    database = Database(url)
    database.open()
    database.migrate()
    access = Access(database, now)
    caller = access.authenticate(access.create_key("bench", Scope.PLANNER, "bench"))
    began, cpu_began = time.perf_counter(), time.process_time()
    if step == "import":
        declaration = DeclarationIn(
            crs="EPSG:4326", vertical_datum="ellipsoid", family="cerpm", columns={"code": "number"}
        )
        given = import_input(declaration, SpooledFile.at(Path(survey)))
        report, _ = Imports(database, now, SameProcess(), MarkerRules()).run(caller, given)
        if report["stored"] != report["rows"]:
            raise SystemExit(f"{report['stored']} of {report['rows']} rows were stored")
    else:
        Path(out).mkdir()
        Exports(database).write_file(caller, step, MarkerFilter(), Path(out))
    figures = {
        "seconds": time.perf_counter() - began,
        "cpu_s": time.process_time() - cpu_began,
        "mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    database.close()
    print(orjson.dumps(figures).decode())


if __name__ == "__main__":
    from app.registry.engines import across_agencies

    with across_agencies():
        main()

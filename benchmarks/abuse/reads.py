"""``python -m benchmarks.abuse.reads [--rows N] [--postgres] [--slack N] [--folder PATH]``: the most expensive reads.

Each is asked for twice on a registry of 200,000 markers: to its end, and abandoned after 0.3 s. The exit status is 1 if
one broke a limit: 5 s of processor time (10 s for files that a process of their own writes), 200 MB of memory, 250 ms
of delay of /healthz; if it had another status than it should; or if the server still worked a second after the client
had left. `--slack` multiplies the limits in time. `--folder` keeps the registry of SQLite for
the next run.
"""

from __future__ import annotations

import argparse
import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlencode

import httpx
import orjson

from app.registry.database import Database
from benchmarks.abuse.cases import star
from benchmarks.abuse.server import Cost, ObservedServer, running_server
from benchmarks.registry.fill import fill, lay_roads
from benchmarks.registry.servers import drop_database, make_database, settle

ROWS = 200_000
MAX_CPU_S, MAX_MEMORY_MB, MAX_HEALTH_MS, MAX_AFTER_S = 5.0, 200.0, 250.0, 0.3
_IN_A_PROCESS, MAX_PROCESS_CPU_S = ("gpkg", "geoparquet", "flatgeobuf", "shapefile"), 10.0
_TOO_MANY = ("kml", "landxml", "dxf")
"""Files that hold fewer markers than this registry: they are refused, and it must cost next to nothing."""
LEFT_AFTER_S, IDLE_AFTER_S = 0.3, 1.0
_NAME = "waymark_bench_reads"
_ITEMS = "/ogc/collections/markers/items?"
_LIKE = " OR ".join(f"code LIKE '%{k}%a%b%c%'" for k in range(20))
_NEAR = {"near": {"lon_deg": 8.0, "lat_deg": 48.0}, "nearest": 1000}


def _polygon(vertices: int) -> dict[str, object]:
    ring = [[8.0 + 5 * (lon - 8.4), 48.0 + 5 * (lat - 49.0)] for lon, lat in star(vertices)]
    return {"polygon": {"type": "Polygon", "coordinates": [ring]}}


READS: dict[str, tuple[str, object]] = {
    "snapshot": ("/v1/snapshots?bbox=-180,-90,180,90", None),
    **{kind: (f"/v1/exports/{kind}", None) for kind in ("csv", "geojson", *_IN_A_PROCESS, *_TOO_MANY)},
    "10,000 items, counted": (f"{_ITEMS}limit=10000&count=true", None),
    "10,000 items in another CRS": (
        f"{_ITEMS}{urlencode({'limit': 10000, 'crs': 'http://www.opengis.net/def/crs/EPSG/0/3857'})}",
        None,
    ),
    "items by 20 patterns, counted": (
        f"{_ITEMS}{urlencode({'filter': _LIKE, 'limit': 10000, 'count': 'true'})}",
        None,
    ),
    "tile of the world": ("/ogc/collections/markers/tiles/WebMercatorQuad/0/0/0", None),
    "tile of groups": ("/ogc/collections/markers/tiles/WebMercatorQuad/0/0/0?groups=true", None),
    "page of 1,000": ("/v1/markers?limit=1000", None),
    "1,000 nearest": ("/v1/markers?near=8,48&nearest=1000", None),
    "1,000 nearest, far away": ("/v1/markers?near=-150,-40&nearest=1000", None),
    "star of 9,999 vertices": ("/v1/markers/search?limit=1000", _polygon(9_999)),
    "1,000 nearest in the star": ("/v1/markers/search", _polygon(9_999) | _NEAR),
}


class Outcome(NamedTuple):
    """A read: its cost and status to its end, and when it was abandoned the processor time until and after a second."""

    name: str
    cost: Cost
    status: int
    answer_mb: float
    abandoned_s: float
    after_s: float

    def broken(self, slack: float) -> list[str]:
        """The limits that it broke."""
        max_cpu_s = MAX_PROCESS_CPU_S if self.name in _IN_A_PROCESS else MAX_CPU_S
        limits = (
            (self.cost.cpu_s, max_cpu_s * slack, "processor time"),
            (self.cost.memory_mb, MAX_MEMORY_MB, "memory"),
            (self.cost.health_ms, MAX_HEALTH_MS * slack, "delay of /healthz"),
            (self.after_s, MAX_AFTER_S, "works on after its client has left"),
        )
        found = [name for value, limit, name in limits if value > limit]
        return found if self.status == (422 if self.name in _TOO_MANY else 200) else [*found, "status"]


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.abuse.reads", description=__doc__)
    parser.add_argument("--rows", type=int, default=ROWS)
    parser.add_argument("--postgres", action="store_true")
    parser.add_argument("--slack", type=float, default=1.0)
    parser.add_argument("--folder", type=Path, default=None)
    parser.add_argument("--only", action="append", choices=READS)
    arguments = parser.parse_args()
    broken = 0
    engine = "PostgreSQL" if arguments.postgres else "SQLite"
    print(f"### abuse-reads-{engine.lower()}\n\nA registry of {arguments.rows} markers, {engine}.\n")
    print("| read | processor time | memory | /healthz | answer | abandoned | a second later | limits |")
    print("|---|---|---|---|---|---|---|---|")
    with (
        _filled(arguments.rows, arguments.folder, postgres=arguments.postgres) as (folder, url, key),
        running_server(folder, WAYMARK_DATABASE_URL=url) as server,
    ):
        for name in arguments.only or READS:
            outcome = _read(server, key, name)
            found, cost = outcome.broken(arguments.slack), outcome.cost
            cells = (
                f"{cost.cpu_s:.2f} s",
                f"{cost.memory_mb:.0f} MB",
                f"{cost.health_ms:.0f} ms",
                f"{outcome.status}, {outcome.answer_mb:.1f} MB",
                f"{outcome.abandoned_s:.2f} s",
                f"{outcome.after_s:.2f} s",
                ", ".join(found) or "kept",
            )
            print(f"| {name} | {' | '.join(cells)} |", flush=True)
            broken += bool(found)
    return 1 if broken else 0


@contextmanager
def _filled(rows: int, kept: Path | None, *, postgres: bool) -> Iterator[tuple[Path, str, str]]:
    """A folder for a server, the URL of a database with so many markers, and a key."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = kept or Path(temporary)
        folder.mkdir(exist_ok=True)
        key_file = folder / ("postgresql.key" if postgres else "sqlite.key")
        url = make_database(_NAME) if postgres else f"sqlite:///{folder / 'waymark.sqlite3'}"
        try:
            if postgres or not key_file.exists():
                database = Database(url)
                database.open()
                database.migrate()
                key_file.write_text(fill(database, lay_roads(rows)))
                database.close()
            if postgres:
                settle(url)
            yield folder, url, key_file.read_text()
        finally:
            if postgres:
                drop_database(_NAME)


def _read(server: ObservedServer, key: str, name: str) -> Outcome:
    path, body = READS[name]
    content = b"" if body is None else orjson.dumps(body)
    method = "GET" if body is None else "POST"
    headers = {"X-API-Key": key, "Content-Type": "application/json"}
    with (
        server.observed() as costs,
        httpx.Client(timeout=600, trust_env=False) as client,
        client.stream(method, f"http://127.0.0.1:{server.port}{path}", content=content, headers=headers) as response,
    ):
        answer_bytes = sum(map(len, response.iter_raw()))
    head = f"{method} {path} HTTP/1.1\r\nHost: x\r\nX-API-Key: {key}\r\nContent-Type: application/json\r\n"
    with server.observed() as until:
        with socket.create_connection(("127.0.0.1", server.port)) as abandoned:
            abandoned.sendall(f"{head}Content-Length: {len(content)}\r\n\r\n".encode() + content)
            time.sleep(LEFT_AFTER_S)
        time.sleep(IDLE_AFTER_S)
    with server.observed() as after:
        time.sleep(1.0)
    return Outcome(name, costs[0], response.status_code, answer_bytes / 1e6, until[0].cpu_s, after[0].cpu_s)


if __name__ == "__main__":
    raise SystemExit(main())

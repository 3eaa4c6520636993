"""Boxes and tiles through HTTP: Waymark on both databases beside tipg on the same PostGIS table, taking turns."""

from __future__ import annotations

import json
import math
import statistics
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

from app.registry.features import FIELDS, TILE_FIELDS
from benchmarks.registry.fill import Network
from benchmarks.registry.load import ask, fetch
from benchmarks.registry.servers import cpu_s, tipg, waymark

BOX_FEATURES, PAGE = 120, 100  # a box holds more than a page, so that a count has to count
ROUNDS = 3
GOALS = {"page": 10.0, "page and count": 5.0, "tiles": 2.0}
ZOOMS = (10, 12, 14)  # below, a tile is of more markers than either draws, and takes tipg seconds


class Registry(Protocol):
    """Filled databases."""

    @property
    def network(self) -> Network: ...
    @property
    def urls(self) -> dict[str, str]: ...
    @property
    def keys(self) -> dict[str, str]: ...


class Measured(NamedTuple):
    """Medians of a server's rounds; the CPU time of a request is that of the server and the database together."""

    per_s: float
    p50_ms: float
    p99_ms: float
    size_kb: float
    cpu_ms: float


@dataclass(frozen=True)
class Asked:
    """What one server is asked: name of the row, port, key, paths."""

    name: str
    port: int
    key: str
    paths: Sequence[str]


@contextmanager
def _servers(registry: Registry, peer_folder: Path) -> Iterator[dict[str, int]]:
    """Ports by name; tipg is missing if it cannot be had here."""
    with ExitStack() as stack:
        ports = {}
        for kind, url in registry.urls.items():
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            ports[kind] = stack.enter_context(waymark(url, folder))
        try:
            ports["tipg"] = stack.enter_context(tipg(registry.urls["PostgreSQL"], peer_folder))
        except (OSError, subprocess.CalledProcessError) as error:
            print(f"tipg could not be run beside: {error}\n")
        yield ports


def measure_boxes(registry: Registry, peer_folder: Path, seconds: float) -> bool:
    """Print requests for boxes of about 100 features; whether the goals were met."""
    boxes = [",".join(f"{side:.7f}" for side in box) for box in registry.network.boxes_of(BOX_FEATURES, 500, seed=2)]
    columns = ",".join(field.name if field.name != "code" else "digits" for field in FIELDS if field.name != "side")
    peer = f"/collections/public.markers/items?limit={PAGE}&f=geojson&properties={columns},spec&bbox="
    ours = f"/ogc/collections/markers/items?limit={PAGE}&bbox="
    with _servers(registry, peer_folder) as ports:
        asked = []
        for kind in registry.keys:
            key = registry.keys[kind]
            asked.append(Asked(f"{kind}, page", ports[kind], key, [ours + box for box in boxes]))
            counted = [f"{ours}{box}&count=true" for box in boxes]
            asked.append(Asked(f"{kind}, page and count", ports[kind], key, counted))
        if "tipg" in ports:
            asked.append(Asked("tipg, page and count", ports["tipg"], "", [peer + box for box in boxes]))
        _compare_answers(asked)
        timings = _take_turns(asked, seconds, registry.urls["PostgreSQL"])
    rows = len(registry.network.lon_deg)
    print(
        f"### registry-boxes\n\n{rows:,} markers; each page has {PAGE} of the {BOX_FEATURES} markers in a box; "
        "16 connections.\n"
    )
    met = _print(timings, lambda name: GOALS[name.partition(", ")[2]])
    print()
    return met


def measure_tiles(registry: Registry, peer_folder: Path, seconds: float) -> bool:
    """Print requests for tiles at several levels; whether the goals were met."""
    columns = ",".join(("id", *(name if name != "code" else "digits" for name in TILE_FIELDS)))
    met, heading = True, True
    with _servers(registry, peer_folder) as ports:
        for zoom in ZOOMS:
            tiles = _tiles(registry.network, zoom)
            asked = []
            for kind in registry.keys:
                paths = [f"/ogc/collections/markers/tiles/WebMercatorQuad/{zoom}/{y}/{x}" for x, y in tiles]
                asked.append(Asked(f"{kind}, level {zoom}", ports[kind], registry.keys[kind], paths))
            if "tipg" in ports:
                tail = f"?properties={columns}"
                url = f"/collections/public.markers/tiles/WebMercatorQuad/{zoom}"
                paths = [f"{url}/{x}/{y}{tail}" for x, y in tiles]
                asked.append(Asked(f"tipg, level {zoom}", ports["tipg"], "", paths))
            timings = _take_turns(asked, seconds, registry.urls["PostgreSQL"])
            if heading:
                print("### registry-tiles\n")
            met &= _print(timings, lambda _: GOALS["tiles"], heading=heading)
            heading = False
    print()
    return met


def _tiles(network: Network, zoom: int) -> list[tuple[int, int]]:
    """Columns and rows of tiles that random markers are on."""
    return [_tile_of(lon, lat, zoom) for _, lon, lat in network.places(200, seed=zoom)]


def _tile_of(lon_deg: float, lat_deg: float, zoom: int) -> tuple[int, int]:
    down = (1 - math.asinh(math.tan(math.radians(lat_deg))) / math.pi) / 2
    return math.floor((lon_deg + 180) / 360 * 2**zoom), math.floor(down * 2**zoom)


def _compare_answers(asked: Sequence[Asked]) -> None:
    """Every server answers the first box with a full page, and those that count with the same count."""
    counts = set()
    for one in asked:
        page = json.loads(fetch(one.port, one.paths[0], one.key))
        if len(page["features"]) != PAGE:
            raise RuntimeError(f"{one.name} answered {len(page['features'])} features")
        if "numberMatched" in page:
            counts.add(page["numberMatched"])
    if len(counts) > 1:
        raise RuntimeError(f"the servers count {sorted(counts)}")


def _take_turns(asked: Sequence[Asked], seconds: float, url: str) -> dict[str, Measured]:
    """Medians of a few rounds: what else the machine does meets all of them."""
    rounds: dict[str, list[Measured]] = {one.name: [] for one in asked}
    for k in range(ROUNDS):
        for one in asked if k % 2 == 0 else asked[::-1]:
            before = cpu_s(one.port, url)
            timing = ask(one.port, one.paths, key=one.key, seconds=seconds)
            spent_s = cpu_s(one.port, url) - before
            cpu_ms = 1e3 * spent_s / timing.answered if timing.answered else math.inf
            rounds[one.name].append(Measured(timing.per_s, timing.p50_ms, timing.p99_ms, timing.size_kb, cpu_ms))
    return {
        name: Measured(*(statistics.median(values) for values in zip(*measured, strict=True)))
        for name, measured in rounds.items()
    }


def _print(found: dict[str, Measured], goal_of: Callable[[str], float], *, heading: bool = True) -> bool:
    peer = next((measured for name, measured in found.items() if name.startswith("tipg")), None)
    if heading:
        print(
            "| server | requests/s | median [ms] | 99 % [ms] | body [kB] | CPU [ms] | x requests/s | x CPU | goal |",
            end="",
        )
        print(" 99 % < its median |\n|---|---|---|---|---|---|---|---|---|---|")
    met = True
    for name, m in found.items():
        compared = "- | - | - | -"
        if peer is not None and m is not peer:
            ratio, goal, quick = _ratio(m.per_s, peer.per_s), goal_of(name), m.p99_ms < peer.p50_ms
            met &= ratio >= goal and quick
            met_goal = f"{goal:g}" if ratio >= goal else f"{goal:g} **no**"
            compared = (
                f"{ratio:.1f} | {_ratio(peer.cpu_ms, m.cpu_ms):.1f} | {met_goal} | {'yes' if quick else '**no**'}"
            )
        figures = f"{m.per_s:.0f} | {m.p50_ms:.1f} | {m.p99_ms:.1f} | {m.size_kb:.0f} | {m.cpu_ms:.1f}"
        print(f"| {name} | {figures} | {compared} |", flush=True)
    return met


def _ratio(one: float, other: float) -> float:
    return one / other if other else math.inf

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
from typing import Protocol

from app.registry.tiles import TILE_FIELDS
from app.services.features import FIELDS
from benchmarks.registry.fill import Network
from benchmarks.registry.load import Timing, ask, fetch
from benchmarks.registry.servers import tipg, waymark

BOX_FEATURES, PAGE = 120, 100  # a box holds more than a page, so that a count has to count
ROUNDS = 3
GOALS = {"page": 10.0, "page and count": 5.0, "tiles": 2.0}
ZOOMS = (8, 10, 12, 14)


class Registry(Protocol):
    """Filled databases."""

    @property
    def network(self) -> Network: ...
    @property
    def urls(self) -> dict[str, str]: ...
    @property
    def keys(self) -> dict[str, str]: ...


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
        timings = _take_turns(asked, seconds)
    rows = len(registry.network.lon_deg)
    print(f"### registry-boxes\n\n{rows:,} markers; pages of {PAGE} of {BOX_FEATURES} in a box; 16 connections.\n")
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
            timings = _take_turns(asked, seconds)
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


def _take_turns(asked: Sequence[Asked], seconds: float) -> dict[str, Timing]:
    """Medians of a few rounds: what else the machine does meets all of them."""
    rounds: dict[str, list[Timing]] = {one.name: [] for one in asked}
    for k in range(ROUNDS):
        for one in asked if k % 2 == 0 else asked[::-1]:
            rounds[one.name].append(ask(one.port, one.paths, key=one.key, seconds=seconds))
    return {
        name: Timing(*(statistics.median(getattr(t, part) for t in timings) for part in Timing.__dataclass_fields__))
        for name, timings in rounds.items()
    }


def _print(timings: dict[str, Timing], goal_of: Callable[[str], float], *, heading: bool = True) -> bool:
    peer = next((timing for name, timing in timings.items() if name.startswith("tipg")), None)
    if heading:
        print("| server | requests/s | median [ms] | 99 % [ms] | body [kB] | times tipg | goal | 99 % < its median |")
        print("|---|---|---|---|---|---|---|---|")
    met = True
    for name, t in timings.items():
        compared = "- | - | -"
        if peer is not None and t is not peer:
            ratio, goal, quick = t.per_s / peer.per_s, goal_of(name), t.p99_ms < peer.p50_ms
            met &= ratio >= goal and quick
            compared = f"{ratio:.1f} | {goal:g} | {'yes' if quick else '**no**'}"
        print(
            f"| {name} | {t.per_s:.0f} | {t.p50_ms:.1f} | {t.p99_ms:.1f} | {t.size_kb:.0f} | {compared} |", flush=True
        )
    return met

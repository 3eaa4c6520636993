"""Searches and matches at the service, without HTTP, and how they grow with the registry."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from datetime import UTC, datetime
from typing import Any

import numpy as np
import shapely

from app.decoding.declarations import CoarsePosition
from app.markers.plate import PlateCode
from app.markers.reading import PlateOutcome, PlateReading
from app.registry.database import Database
from app.registry.features import FeatureFilter
from app.registry.markers import MarkerFilter
from app.registry.spatial import Area, Box
from app.services.access.access import Access, Caller
from app.services.decodes.matching import find_nearby_markers, match_reading
from app.services.markers.features import MARKERS, Features
from app.services.markers.searches import Searches
from benchmarks.registry.fill import CERPM_EVERY, PER_ROAD, SPACING_M, Network
from benchmarks.registry.serving import BOX_FEATURES, PAGE, Registry

TIMES = 300
GOAL_MS = 5.0
COARSE_M = 15.0
RADIUS_M = 200.0
NEAREST = 10
ALONG = 80  # markers of a road, from its start
Search = Callable[[int, float, float], object]
Medians = dict[tuple[str, str], float]  # by search and database [ms]


def measure_searches(registry: Registry) -> tuple[bool, Medians]:
    """Print the searches at one size; whether each has its median below the goal on both databases, and the medians."""
    rows = len(registry.network.lon_deg)
    print(f"### registry-searches\n\n{rows:,} markers; {TIMES} random positions, one search after the other.\n")
    print(f"| search | database | median [ms] | 99 % [ms] | below {GOAL_MS:g} ms |\n|---|---|---|---|---|")
    met, medians = True, {}
    for kind in registry.urls:
        for name, (p50, p99) in _measured(registry, kind).items():
            medians[name, kind] = p50
            good = p50 < GOAL_MS
            met &= good or name.startswith("along")  # the goal is for a place, not for a line
            goal = "-" if name.startswith("along") else "yes" if good else "**no**"
            print(f"| {name} | {kind} | {p50:.2f} | {p99:.2f} | {goal} |", flush=True)
    print()
    return met, medians


def measure_growth(
    sizes: Sequence[int], filled: Callable[[int], AbstractContextManager[Registry]], known: dict[int, Medians]
) -> bool:
    """Print the medians at growing sizes; whether matching stays below the goal at the greatest."""
    found = dict(known)
    for rows in sizes:
        if rows not in found:
            with filled(rows) as registry:
                found[rows] = {
                    (name, kind): p50 for kind in registry.urls for name, (p50, _) in _measured(registry, kind).items()
                }
    print("### registry-growth\n\nMedian time in the service layer [ms] by the number of markers.\n")
    print(f"| search | database | {' | '.join(f'{rows:,}' for rows in sizes)} |\n|---|---|{'---|' * len(sizes)}")
    for name, kind in found[sizes[-1]]:
        print(f"| {name} | {kind} | {' | '.join(f'{found[rows][name, kind]:.2f}' for rows in sizes)} |")
    return all(p50 < GOAL_MS for (name, _), p50 in found[sizes[-1]].items() if name.startswith("match"))


def _measured(registry: Registry, kind: str) -> dict[str, tuple[float, float]]:
    """Median and 99th percentile of each search. [ms]"""
    with _opened(registry.urls[kind], registry.keys[kind]) as (database, caller):
        searches = _searches(database, caller, registry.network)
        places = registry.network.places(TIMES, seed=3)
        return {name: _timed(search, places) for name, search in searches.items()}


@contextmanager
def _opened(url: str, key: str) -> Iterator[tuple[Database, Caller]]:
    database = Database(url)
    database.open()
    try:
        yield database, Access(database, lambda: datetime.now(UTC)).authenticate(key)
    finally:
        database.close()


def _timed(search: Search, places: Sequence[tuple[int, float, float]]) -> tuple[float, float]:
    for place in places[:20]:
        search(*place)
    took_ms = []
    for place in places:
        began = time.perf_counter()
        search(*place)
        took_ms.append(1e3 * (time.perf_counter() - began))
    return statistics.median(took_ms), statistics.quantiles(took_ms, n=100)[-1]


def _searches(database: Database, caller: Caller, network: Network) -> dict[str, Search]:
    """What is timed, by name; each gets the row and the place of a marker."""
    searches, features = Searches(database), Features(database, lambda: datetime.now(UTC))
    boxes = [Box(*box) for box in network.boxes_of(BOX_FEATURES, 100, seed=4)]
    areas = [_diamond(box) for box in boxes]

    def box(k: int, _lon: float, _lat: float) -> object:
        return features.page(caller, MARKERS, FeatureFilter(box=boxes[k % len(boxes)]), limit=PAGE)

    def near(_k: int, lon: float, lat: float) -> object:
        return searches.page(caller, MarkerFilter(near=(lon, lat, RADIUS_M)), limit=100)

    def nearest(_k: int, lon: float, lat: float) -> object:
        return searches.nearest(caller, MarkerFilter(), (lon + 3e-4, lat - 2e-4), NEAREST)

    def along(k: int, _lon: float, _lat: float) -> object:
        first = min(k - k % PER_ROAD, len(network.lon_deg) - ALONG)
        line = np.column_stack((network.lon_deg, network.lat_deg))[first : first + ALONG : 4].tolist()
        return searches.along(caller, MarkerFilter(), line, 20.0, limit=100)

    def polygon(k: int, _lon: float, _lat: float) -> object:
        area = areas[k % len(areas)]
        return searches.page(caller, MarkerFilter(area=area), limit=PAGE)

    def on_road(k: int, _lon: float, _lat: float) -> object:
        from_m = min(k % PER_ROAD, PER_ROAD - ALONG) * SPACING_M
        piece = MarkerFilter(road=f"A{k // PER_ROAD}", from_m=from_m, to_m=from_m + ALONG * SPACING_M)
        return searches.page(caller, piece, limit=100)

    def match(k: int, _lon: float, _lat: float) -> object:
        k = k if k % CERPM_EVERY else k + 1
        k = min(k, len(network.lon_deg) - 1)
        lon, lat = float(network.lon_deg[k]), float(network.lat_deg[k])
        reading = PlateReading(PlateOutcome.READ, code=PlateCode.from_position(lon, lat), confidence=1.0)
        position = CoarsePosition(lon_deg=lon + 5e-5, lat_deg=lat - 5e-5, accuracy_m=COARSE_M)
        with database.read() as connection:
            nearby = find_nearby_markers(connection, caller.agency_id, position)
            return _found(match_reading(connection, caller.agency_id, reading, position, nearby))

    return {
        f"box of {BOX_FEATURES}": box,
        f"radius {RADIUS_M:g} m": near,
        f"nearest {NEAREST}": nearest,
        f"polygon in the box of {BOX_FEATURES}": polygon,
        f"{ALONG * SPACING_M / 1000:g} km of a road": on_road,
        f"along {ALONG * SPACING_M / 1000:g} km": along,
        "match code + coarse position": match,
    }


def _diamond(box: Box) -> Area:
    """The polygon through the middles of a box's edges."""
    lon, lat = (box.west_deg + box.east_deg) / 2, (box.south_deg + box.north_deg) / 2
    corners = [(box.west_deg, lat), (lon, box.north_deg), (box.east_deg, lat), (lon, box.south_deg)]
    return Area(shapely.to_wkb(shapely.Polygon(corners), byte_order=1), (box,))


def _found(match: Any) -> Any:
    if match is None or match.row is None:
        raise RuntimeError("a registered plate was not found")
    return match

"""Hand-made worst cases: uploads, forms, queries, and bodies whose values are allowed and costly."""

from __future__ import annotations

import io
import json
import math
import struct
import zipfile
import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from app.families.magnet.layouts import MAGNET_EXAMPLES


class Case(NamedTuple):
    """A request: its route in the OpenAPI document, what it tries, and what is sent."""

    route: str
    name: str
    method: str
    path: str
    options: dict[str, Any]


def list_cases(ids: dict[str, str], *, short: bool) -> Iterator[Case]:
    """All hand-made cases. The ids are those of resources that exist, by the names of path parameters."""
    yield from _documents(ids, short=short)
    yield from _queries(short=short)
    yield from _uploads(short=short)


def _json(path: str, name: str, body: object, route: str | None = None) -> Case:
    return Case(f"POST {route or path}", name, "POST", path, {"json": body})


def _get(path: str, name: str, **parameters: str) -> Case:
    return Case(f"GET {path}", name, "GET", path, {"params": parameters})


def _zigzag(vertices: int) -> list[list[float]]:
    return [[456_000 + 0.3 * k, 5_427_000 + 40.0 * (k % 2)] for k in range(vertices)]


def star(vertices: int) -> list[list[float]]:
    """A closed ring of a star about 8.4, 49.0, 0.2 degrees to its points."""
    ring = [
        [8.4 + (0.1 + 0.1 * (k % 2)) * math.cos(angle), 49.0 + (0.1 + 0.1 * (k % 2)) * math.sin(angle)]
        for k, angle in enumerate(np.linspace(0, 2 * math.pi, vertices - 1, endpoint=False).tolist())
    ]
    return [*ring, ring[0]]


def _documents(ids: dict[str, str], *, short: bool) -> Iterator[Case]:
    vertices = 4_000 if short else 40_000
    yield _json(
        "/v1/markers/search", "a star of vertices", {"polygon": {"type": "Polygon", "coordinates": [star(9_999)]}}
    )
    line = {"type": "LineString", "coordinates": [[8.4 + 1e-5 * k, 49.0 + 1e-5 * (k % 2)] for k in range(vertices)]}
    yield _json("/v1/markers/search", "along a zigzag", {"along": {"geometry": line, "corridor_m": 100}})
    yield _json("/v1/markers/bulk", "a thousand plates", {"items": [{"create": plate} for plate in _plates(1_000)]})
    dry = {"items": [{"create": MAGNET_EXAMPLES[0]}] * 300, "dry_run": True}
    yield _json("/v1/markers/bulk", "magnets", dry)
    lines = [{"create": _line_magnets(k)} for k in range(30)]
    yield _json("/v1/markers/bulk", "30 lines of magnets", {"items": lines, "dry_run": True})
    zigzag = {"type": "LineString", "coordinates": _zigzag(vertices)}
    yield _json("/v1/roads", "a zigzag", {"name": "zigzag", "crs": "EPSG:25832", "geometry": zigzag})
    positions = {"positions": [[8.4 + 1e-5 * k, 49.0] for k in range(1_000)], "max_offset_m": 1_000}
    where = "/v1/roads/{road_id}/locate"
    yield _json(where.format(**ids), "a thousand positions", positions, where)
    radio = {"interval_s": 0.05, "spreading_factor": 7, "bandwidth_hz": 500_000}
    receiver = {"sensitivity_dbm": -150.0}
    slow = {"radio": radio, "receiver": receiver, "design_speed_m_s": 0.5}
    yield _json("/v1/radio-checks", "short interval, slow, sensitive", slow)
    yield _json("/v1/radio-checks", "recommend, slow", slow | {"recommend": True})
    placed = {"chainage_m": [float(k) for k in range(5_000)], "offset_m": [1.8] * 5_000}
    yield _json("/v1/radio-checks", "5,000 markers", {"markers": placed, "recommend": True})
    for magnets in (4,) if short else (5, 6, 7):
        design = {"magnets": magnets, "length_m": 4.0, "segment_m": 0.05}
        book = {"name": f"M{magnets}", "design": design, "rules": {"speed_m_s": 13.4, "clearance_m": 0.3}}
        yield _json("/v1/codebooks", f"{magnets} magnets", book)
    formats = {"formats": ["pdf", "svg", "dxf", "png"], "resolution_dpi": 300}
    yield _json("/v1/artwork", "40 plates", formats | {"bbox": [9.9, 49.99, 11.0, 50.01]})


def _plates(count: int) -> Iterator[dict[str, Any]]:
    for k in range(count):
        position = {"lon_deg": 10.012345 + 0.020321 * (k % 40), "lat_deg": 50.001234 + 0.020123 * (k // 40)}
        yield {"position": position, "status": "planned"}


def _line_magnets(number: int) -> dict[str, Any]:
    """330 magnets: all 30 lines are just within the limit of a request."""
    lat_deg = 42.7 + 1e-4 * number
    lane = {"geometry": {"type": "LineString", "coordinates": [[-84.48, lat_deg], [-84.47, lat_deg]]}}
    line = {"style": "solid", "from_m": 1.0, "to_m": 330.0, "spacing_m": 1.0}
    return {"family": "magnet", "lane": lane, "line": line}


def _queries(*, short: bool) -> Iterator[Case]:
    ring = ", ".join(f"{x:.4f} {y:.4f}" for x, y in star(350))
    yield _get("/v1/markers", "a polygon", polygon=f"POLYGON (({ring}))")
    items = "/ogc/collections/{collection}/items"
    path = items.format(collection="markers")
    nested = "(" * 900 + "code='1'" + ")" * 900
    many = " OR ".join(f"code LIKE '%{k}%a%b%c%'" for k in range(150))
    for name, parameters in {
        "a nested filter": {"filter": nested},
        "many patterns": {"filter": many, "limit": "10000", "count": "true"},
        "a deep filter in JSON": {"filter": '{"op":"not","args":[' * 300, "filter-lang": "cql2-json"},
        "all in another CRS": {"limit": "10000", "crs": "http://www.opengis.net/def/crs/EPSG/0/3857"},
    }.items():
        yield Case(f"GET {items}", name, "GET", path, {"params": parameters})
    for kind in (
        ("csv", "gpkg")
        if short
        else ("csv", "geojson", "gpkg", "geoparquet", "flatgeobuf", "shapefile", "kml", "landxml", "dxf")
    ):
        yield Case("GET /v1/exports/{kind}", kind, "GET", f"/v1/exports/{kind}", {})
    yield _get("/v1/snapshots", "the world", bbox="-180,-90,180,90")


def _uploads(*, short: bool) -> Iterator[Case]:
    members = ("{" + ",".join(f'"a{number}":0' for number in range(5_000)) + "}").encode()[:64_000]
    picture = _noise(200)
    for name, file, context in (
        ("a wide context", picture, members),
        ("a context of lists", picture, b'{"trace":' + b"[[]," * 15_000),
        ("a huge picture", _huge_png(), b"{}"),
        ("noise", _noise(600 if short else 3_000), b"{}"),
        ("an archive bomb", _bomb(), b"{}"),
    ):
        yield _form("/v1/decodes", name, file, "context", context)
    rows = 20_000 if short else 60_000
    bad = b"longitude,latitude\n" + b"x,y\n" * rows
    same = b"lon_deg,lat_deg\n" + b"8.4,49.0\n" * rows
    for name, file in (
        ("wrong rows", bad),
        ("equal rows", same),
        ("one long cell", b"lon_deg,lat_deg\n" + b"x" * 1_000_000 + b",1\n"),
        ("deep XML", b"<a>" * 200_000),
        ("deep GeoJSON", b'{"type":' + b"[" * 500_000),
        ("entities", _entities()),
    ):
        yield _form("/v1/imports", name, file, "declaration", b'{"crs": "EPSG:4326", "dry_run": true}')
        yield _form("/v1/alignments", name, file, "declaration", b'{"name": "a"}')
    photos = [
        ("photos", (f"{k}.jpg", _noise(300 if short else 1_200), "image/jpeg")) for k in range(6 if short else 60)
    ]
    board = json.dumps({"board": {"columns": 9, "rows": 6, "square_mm": 30}})
    declared = [*photos, ("declaration", (None, board))]
    yield Case("POST /v1/calibrations", "noise", "POST", "/v1/calibrations", {"files": declared})


def _form(path: str, name: str, file: bytes, part: str, text: bytes) -> Case:
    options = {"files": {"file": ("upload", file)}, "data": {part: text.decode()}}
    return Case(f"POST {path}", name, "POST", path, options)


def _noise(side: int) -> bytes:
    """A JPEG of noise: every cell may be the corner of a marker."""
    pixels = np.random.default_rng(1).integers(0, 256, (side, side), dtype=np.uint8)
    out = io.BytesIO()
    Image.fromarray(np.kron(pixels[: side // 4, : side // 4], np.ones((4, 4), dtype=np.uint8))).save(out, "JPEG")
    return out.getvalue()


def _huge_png() -> bytes:
    """0.2 kB that claim 60,000 x 60,000 pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    pixels = zlib.compress(bytes(60_000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def _bomb() -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for number in range(20):
            archive.writestr(f"{number}.jpg", bytes(20_000_000))
    return out.getvalue()


def _entities() -> bytes:
    """Entities that name each other: 10^11 characters (CWE-776)."""
    lines = [f'<!ENTITY a{k} "{(f"&a{k - 1};" * 10) if k else "a"}">' for k in range(12)]
    return f"<?xml version='1.0'?><!DOCTYPE a [{''.join(lines)}]><a>&a11;</a>".encode()

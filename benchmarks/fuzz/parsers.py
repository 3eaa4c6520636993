"""Every parser of bytes that come from outside, with files to damage; each may raise the errors of its domain alone."""

from __future__ import annotations

import io
import json
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, settings

from app.api.ogc.cql2 import Reader
from app.api.ogc.query import places_in
from app.decoders.cerpm.verify import decode_message
from app.encoders.cerpm import encode_message
from app.errors import WaymarkError
from app.formats.alignments.read import read_alignment
from app.formats.format import SpooledFile, read_members
from app.formats.images import ImageLimits, scan_image
from app.formats.json_text import parse_json
from app.formats.kinds import detect_drive_file, guess_kind
from app.formats.packets.read import read_packets
from app.formats.poses import read_poses
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.formats.traces.read import read_trace
from app.markers.cerpm import KEY_BYTES, CerpmMessage
from app.planning.rules import read_rules
from app.services.markers.features import STORAGE_CRS
from benchmarks.fuzz.mutations import damaged
from benchmarks.fuzz.pictures import list_pictures

ROOT = Path(__file__).resolve().parents[2]
CORPUS = ROOT / "tests" / "data" / "fuzz"
"""Inputs that once broke a parser, in a folder per parser: they are tried first, for ever."""
MAX_CPU_S = 5.0
"""Most processor time for one file. [s] Source: docs/reliability.md, the bound of a request."""
MAX_MESSAGE = 2000
"""Most characters of an error's message: it may quote the file, but not all of it. Source: chosen by hand."""
_SEED_BYTES = 60_000  # larger files make hypothesis slow; source: chosen by hand


@dataclass(frozen=True, slots=True)
class Parser:
    """A parser and the files that are damaged for it."""

    name: str
    parse: Callable[[bytes], object]
    seeds: Sequence[bytes]


@dataclass(slots=True)
class Outcome:
    """What came of many files."""

    tried: int = 0
    accepted: int = 0
    refused: Counter[str] = field(default_factory=Counter)  # by class of error
    slowest_s: float = 0.0  # [s] most time of one file: processor time of a parser, waiting time of a picture
    # errors of no domain, and files that take too long, at the smallest input found
    failures: list[str] = field(default_factory=list)


def attack(parser: Parser, *, seconds: float | None = None, examples: int = 500, seed: int | None = None) -> Outcome:
    """Give a parser damaged files, for some seconds or a number of examples.

    Parameters
    ----------
    parser : Parser
    seconds : float, optional
        Rounds of `examples` go on for so long; one round without. [s]
    examples : int
    seed : int, optional
        The same files every time; without, others each time.
    """
    outcome = Outcome()
    for path in sorted((CORPUS / parser.name).glob("*")):
        _try(parser, path.read_bytes(), outcome)
    phases = (Phase.explicit, Phase.generate, Phase.shrink)

    @settings(
        max_examples=examples, deadline=None, derandomize=seed is not None, database=None, phases=phases,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(damaged(parser.seeds))
    def one_round(data: bytes) -> None:
        _try(parser, data, outcome)

    end = time.monotonic() + (seconds or 0.0)
    try:
        one_round()
        while seconds is not None and time.monotonic() < end:
            one_round()
    except Exception:  # noqa: BLE001 - whatever it is, it is what we look for
        outcome.failures.append(traceback.format_exc())
    return outcome


def _try(parser: Parser, data: bytes, outcome: Outcome) -> None:
    began = time.process_time()
    outcome.tried += 1
    refusal: WaymarkError | None = None
    try:
        parser.parse(data)
        outcome.accepted += 1
    except WaymarkError as error:
        outcome.refused[type(error).__name__] += 1
        refusal = error
    if refusal is not None and not 0 < len(refusal.message) < MAX_MESSAGE:
        raise AssertionError(f"a message of {len(refusal.message)} characters")
    spent_s = time.process_time() - began
    outcome.slowest_s = max(outcome.slowest_s, spent_s)
    assert spent_s < MAX_CPU_S, f"{spent_s:.1f} s of processor time for {len(data)} bytes"


def _files(*patterns: str) -> list[bytes]:
    found = [path for pattern in patterns for path in sorted(ROOT.glob(pattern)) if path.is_file()]
    return [path.read_bytes() for path in found if path.stat().st_size < _SEED_BYTES]


def _short_recording() -> bytes:
    """The first seconds of the recording in docs/images, as an archive."""
    short = io.BytesIO()
    with zipfile.ZipFile(ROOT / "docs" / "images" / "drive.zip") as drive, zipfile.ZipFile(short, "w") as archive:
        for name in drive.namelist():
            archive.writestr(name, b"\n".join(drive.read(name).splitlines()[:400]))
    return short.getvalue()


def _road_part(data: bytes) -> bytes:
    """A collection with the first feature of a GeoJSON."""
    document = json.loads(data)
    return json.dumps({**document, "features": document["features"][:1]}).encode()


_CSV = b"""point,easting,northing,height,code,description
1,456789.123,5427890.456,112.34,,plate 1
2,456799.123,5427891.456,112.44,,plate 2
3,456809.123,5427892.456,112.54,,plate 3
"""
_PNEZD = b"1,5427890.456,456789.123,112.34,PL\n2,5427891.456,456799.123,112.44,PL\n"
_GEOJSON = b"""{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"point": "1", "code": "7"},
"geometry": {"type": "Point", "coordinates": [8.4, 49.0, 112.3]}}]}"""
_LANDXML = b"""<?xml version="1.0"?><LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2"><Units>
<Metric linearUnit="meter"/></Units><CoordinateSystem epsgCode="25832"/><CgPoints><CgPoint name="1">5427890.4 456789.1
112.3</CgPoint></CgPoints></LandXML>"""
_NMEA = b"""$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47
$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A
"""
_GPX = b"""<?xml version="1.0"?><gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
<trkpt lat="49.0" lon="8.4"><ele>112</ele><time>2026-05-28T20:26:41Z</time></trkpt>
<trkpt lat="49.0001" lon="8.4"><time>2026-05-28T20:26:42Z</time></trkpt></trkseg></trk></gpx>"""
_TRACK = b"t,lon_deg,lat_deg,heading_deg,accuracy_m\n0.0,8.4,49.0,90,0.5\n1.0,8.4001,49.0,90,0.5\n"
_PACKETS = (
    b'{"deviceInfo": {"devEui": "70b3d57ed0001234"}, "time": "2026-05-28T20:26:41.773Z", '
    b'"data": "GgAAA4XM89LgGS9PuDBMGQAAAAA=", "rxInfo": [{"rssi": -105, "snr": 5.5}]}\n',
    b'{"uplink_message": {"frm_payload": "GgAAA4XM89LgGS9PuDBMGQAAAAA=", "received_at": "2026-05-28T20:26:41.773Z",'
    b' "rx_metadata": [{"rssi": -105, "snr": 5.5}]}}\n',
    b"1716928001.773,1a00000385ccf3d2e0192f4fb8304c1900000000,-105,5.5\n",
)
_RULES = b"""version: 1
plates: {spacing_m: 100}
cerpm: {n_m: 12.192, max_path_error_m: 0.05}
"""
_BODY = (
    b'{"position": {"lon_deg": 8.4, "lat_deg": 49.0}, "status": "planned", "tags": ["a", 1, null, true]}',
    json.dumps({"rows": [[k, k / 7, str(k), {"n": None}] for k in range(40)]}).encode(),
)
_CQL2 = (
    b"family = 'plate' AND version > 3",
    b"road LIKE 'A%' OR NOT (measure_m BETWEEN 1 AND 2)",
    b"updated_at > '2026-01-01T00:00:00Z'",
    b"status IN ('planned', 'built') AND road IS NOT NULL",
)
_CQL2_JSON = (
    b'{"op": "and", "args": [{"op": "=", "args": [{"property": "family"}, "plate"]}, '
    b'{"op": ">", "args": [{"property": "version"}, 3]}]}',
    b'{"op": "not", "args": [{"op": "between", "args": [{"property": "measure_m"}, 1, 2]}]}',
)
_KINDS = {
    "family": "string", "road": "string", "status": "string", "version": "integer", "measure_m": "number",
    "updated_at": "date-time",
}  # fmt: skip


def _filters(language: str) -> Callable[[bytes], object]:
    reader = Reader(
        _KINDS,
        lambda text: datetime.fromisoformat(text).astimezone(UTC),
        float,
        places_in(STORAGE_CRS),
    )

    def parse(data: bytes) -> object:
        try:
            return reader.read(data.decode("utf-8", "replace"), language)
        except ValueError:  # the callables of this test are not those of the service, which raise its errors
            return None

    return parse


def _survey(data: bytes) -> object:
    return read_survey(data, ImportDeclaration(crs="EPSG:25832", vertical_datum="ellipsoid"))


def _pnezd(data: bytes) -> object:
    return read_survey(data, ImportDeclaration(layout="pnezd", crs="EPSG:25832", vertical_datum="ellipsoid"))


def list_parsers() -> list[Parser]:
    """All parsers."""
    pictures = list_pictures()
    lanes = [_road_part(path.read_bytes()) for path in (ROOT / "tests" / "data" / "alignments").glob("*.geojson")]
    roads = [*lanes, *_files("tests/data/lanelet2/*.osm", "tests/data/opendrive/*.xodr", "app/demo/data/*.geojson")]
    archives = [_short_recording()]
    kinds = [*pictures, *archives, _CSV, _NMEA]
    cerpm = [encode_message(CerpmMessage(901, -85.6436, 42.2531, 236.4), bytes(KEY_BYTES))]
    return [
        Parser("json", parse_json, [*_BODY, _GEOJSON]),
        Parser("surveys", _survey, [_CSV, _GEOJSON, _LANDXML, *_files("tests/data/surveys/**/*")]),
        Parser("pnezd", _pnezd, [_PNEZD, _CSV]),
        Parser("alignments", read_alignment, [*roads, _LANDXML]),
        Parser("packets", lambda data: read_packets("log", data), [*_PACKETS, *_files("docs/images/packets.csv")]),
        Parser("poses", lambda data: read_poses("track", data), [_NMEA, _GPX, _TRACK]),
        Parser("traces", lambda data: read_trace({"drive.zip": data}), archives),
        Parser("archives", lambda data: sum(len(member.data) for member in read_members(data)), archives),
        Parser("image-headers", lambda data: scan_image(data, ImageLimits(), thermal=False), pictures),
        Parser(
            "kinds", lambda data: (guess_kind("file", SpooledFile.of(data)), detect_drive_file("file", data)), kinds
        ),
        Parser("rules", read_rules, [_RULES, *_files("app/demo/data/e6-rules.yaml")]),
        Parser("cql2-text", _filters("cql2-text"), _CQL2),
        Parser("cql2-json", _filters("cql2-json"), _CQL2_JSON),
        Parser("cerpm-message", decode_message, cerpm),
    ]

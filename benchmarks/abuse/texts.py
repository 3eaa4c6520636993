"""Hostile YAML, JSON, TOML, XML and CSV from a seed, and the requests that send them to every route that takes text."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from typing import Any

from benchmarks.abuse.cases import Case

DEPTH = 10_000
_LONG = 4_301
"""Digits of an integer; Python reads 4,300 of a text."""
_NUMBERS = (
    "9" * _LONG,
    "-" + "9" * 400,
    "0x" + "f" * 4000,
    "1e400",
    "-1e-400",
    "NaN",
    ".nan",
    "-Infinity",
    "-.inf",
    "0777",
)
_WORDS = (
    "",
    "null",
    "~",
    "true",
    "[]",
    "{}",
    '"\\ud800"',
    '"\\u0000"',
    "2001-13-45",
    "0001-01-01T00:00:00+23:59",
    "\u202e",
    "\ufeff",
    "\u0661\u0662",
    "=1+1",
    "%s%n",
    "'" + "x" * 20_000 + "'",
    "\x00",
    "\x1b[2J",
)
_YAML = (
    "? [1, {a: 1}]\n: x",
    "? {a: 1}\n: x",
    "1: 2",
    "null: 1",
    "a: &x [1]\nb: *x",
    "a: &a [*a]",
    "<<: {a: 1}",
    "<<: 5",
    "a: !!python/object/apply:os.system [x]",
    "a: !!binary x",
    "a: !!int ''",
    "a: !!timestamp x",
    "a: !!set {a, a}",
    "%YAML 9.9\n---\na: 1",
    "%TAG ! x\n---\na: !b c",
    "--- 1\n--- 2",
    "a: b\na: c",
    "a: |\n \t",
    "a:\tb",
    "- " * DEPTH,
    "\n" * 49_000,
    "[" * DEPTH,
    "{a: " * DEPTH,
    "? " * DEPTH,
    "a: b\n" * 9_000,
    "[" + "a," * 20_000 + "]",
    "&a " * 9_000,
    "a: >\n" + " x\n\n" * 9_000,
    '"' + "\\\n" * 20_000,
    "#" * 49_000,
    "a: 1:2:3",
    "a: 1_000",
    "a: 0b2",
    "a: 0o9",
    "&l0 [x,x]\n" + "\n".join(f"&l{k} [*l{k - 1},*l{k - 1}]" for k in range(1, 30)),
)
_TOML = (
    "a = 1\n[[a]]",
    "a" + ".a" * DEPTH + " = 1",
    "[" * DEPTH,
    "a = 1979-13-45",
    'a = """' + "x" * 9_000,
    "a = {b = 1,}",
)
_JSON = (
    "[" * DEPTH + "]" * DEPTH,
    '{"a":' * DEPTH + "1" + "}" * DEPTH,
    '{"a": 1, "a": 2}',
    '{"": {}}',
    "[1,]",
    "{'a': 1}",
    "// a\n{}",
    '{"a": "\\ud800\\ud800"}',
    '{"\\ud800": 1}',
    '{"\\u0000": 1}',
    "[" + "0," * 100_000 + "0]",
    "\ufeff{}",
    "{",
    '"' + "x" * 100_000 + '"',
    '{"__proto__": {}, "$ref": "#"}',
    '{"a": 1}{"a": 2}',
    '{"a": "\t"}',
    "{" + '"a":{}' * 9,
)
_ENTITIES = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10 if k else "a"}">' for k in range(12))
_XML = (
    f"<!DOCTYPE a [{_ENTITIES}]><a>&a11;</a>",
    '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><a>&x;</a>',
    '<!DOCTYPE a [<!ENTITY % p SYSTEM "http://127.0.0.1:9/x.dtd"> %p;]><a/>',
    '<!DOCTYPE a SYSTEM "http://127.0.0.1:9/x.dtd"><a/>',
    f'<!DOCTYPE a [<!ENTITY x "{"x" * 50_000}">]><a>{"&x;" * 5_000}</a>',
    "<a>" * DEPTH + "</a>" * DEPTH,
    "<a>" * DEPTH,
    "<a>" + "<b/>" * 50_000 + "</a>",
    "<a><b></a>",
    "<a>&#0;</a>",
    "<a b='1' b='2'/>",
    "<x:a/>",
    "<a " + " ".join(f"b{k}='1'" for k in range(20_000)) + "/>",
    f"<{'a' * 50_000}/>",
    f"<a b='{'9' * 100_000}'/>",
    '<?xml version="1.0" encoding="utf-7"?><a>+ADw-</a>',
    '<?xml version="1.0" encoding="utf-16"?><a/>',
    "<a><![CDATA[" * 99,
    '<?xml version="9.0" encoding="idna"?><a/>',
    '<a xmlns:xi="http://www.w3.org/2001/XInclude"><xi:include href="/etc/passwd"/></a>',
)
_CSV = (
    "",
    ",",
    '"',
    "lon_deg,lat_deg\n",
    'lon_deg,lat_deg\n"8,49\n' * 3,
    "lon_deg,lat_deg\n" + "," * 100_000,
    ",".join(f"c{k}" for k in range(DEPTH)) + "\n" + "1," * DEPTH,
    "lon_deg,lon_deg\n1,2\n",
    "lon_deg,lat_deg\r8,49\r9,49\r",
    "lon_deg;lat_deg\n8,4;49,0\n",
    "sep=;\nlon_deg;lat_deg\n8;49\n",
    "lon_deg,lat_deg\n" + "x" * 300_000 + ",1\n",
    "\n" * 99_999,
    "lon_deg,lat_deg\n" + '"' * 99_999,
    "lon_deg\tlat_deg\n8\t49\n",
    "lon_deg|lat_deg\n8|49\n",
)
_TEMPLATES = {
    "yaml": ("version: {}", "version: 1\nplates: {{spacing_m: {}}}", "version: 1\n{}: 1", "version: 1\nname: {}", "{}"),
    "json": (
        '{{"version": {}}}',
        '{{"version": 1, "plates": {{"spacing_m": {}}}}}',
        '{{"type": "FeatureCollection", '
        '"features": [{{"type": "Feature", "properties": {{"code": {0}}}, "geometry": {{"type": "LineString", '
        '"coordinates": [[8.4, {0}], [8.5, 49]]}}}}]}}',
        "[{}]",
        "{}",
    ),
    "toml": ("version = {}", "[plates]\nspacing_m = {}"),
    "xml": (
        '<LandXML><Units><Metric linearUnit="{0}"/></Units><CgPoints><CgPoint name="{0}">{0} {0} 1</CgPoint></CgPoints>'
        "</LandXML>",
        '<osm version="0.6"><node id="{0}" lat="{0}" lon="8.4"/><way id="1"><nd ref="{0}"/></way></osm>',
        '<OpenDRIVE><header revMajor="{0}"/><road length="{0}" id="{0}"><planView><geometry s="0" x="{0}" y="0" hdg="0"'
        ' length="{0}"><line/></geometry></planView></road></OpenDRIVE>',
        "<kml><Document><Placemark><name>{0}</name><Point><coordinates>{0},49</coordinates></Point></Placemark></Document></kml>",
        "<JOBFile><FieldBook><PointRecord><Name>{0}</Name><Grid><North>{0}</North></Grid></PointRecord></FieldBook></JOBFile>",
        '<gpx version="1.1"><trk><trkseg><trkpt lat="{0}" lon="8.4"><time>{0}</time></trkpt></trkseg></trk></gpx>',
    ),
    "csv": (
        "lon_deg,lat_deg\n{0},{0}\n8.4,49\n",
        "point,easting,northing,code\n1,{0},{0},{0}\n",
        "time_s,payload,rssi_dbm\n{0},{0},{0}\n",
        "t,lon_deg,lat_deg,heading_deg\n{0},8.4,49,{0}\n",
        "$GPGGA,{0},4807.038,N,01131.000,E,1,08,{0},545.4,M,46.9,M,,*47\n",
    ),
}
_WHOLE = {"yaml": _YAML, "json": _JSON, "toml": _TOML, "xml": _XML, "csv": _CSV}
FORMS = tuple(_WHOLE)
_ENCODINGS = ("utf-8-sig", "utf-16", "utf-16-le", "utf-32", "cp037")
_BYTES = (b"\xff", b"\xed\xa0\x80", b"\xc0\x80", b"\x00", b"\xef\xbb\xbf\xef\xbb\xbf", b"\xfe\xff\x00")


def list_texts(form: str, *, seed: int, mutations: int) -> Iterator[bytes]:
    """Hostile texts of a form: all that are written down here, then mutations and mixtures of them by the seed."""
    texts = [text.encode("utf-8", "surrogatepass") for text in _WHOLE[form]]
    for template in _TEMPLATES[form]:
        texts += [template.format(value).encode("utf-8", "surrogatepass") for value in (*_NUMBERS, *_WORDS)]
    plain = _TEMPLATES[form][0].format(1)
    texts += [plain.encode(encoding) for encoding in _ENCODINGS] + [plain.encode() + part for part in _BYTES]
    yield from texts
    chance = random.Random(f"{form} {seed}")
    for _ in range(mutations):
        yield _mutated(chance, texts)


def _mutated(chance: random.Random, texts: list[bytes]) -> bytes:
    text, other = (one[:2_000] for one in chance.sample(texts, 2))
    at, to = sorted(chance.randrange(len(text) + 1) for _ in range(2))
    match chance.randrange(4):
        case 0:
            return text[:at] + other + text[to:]
        case 1:
            return text[:at] + chance.choice(_BYTES) + text[at:]
        case 2:
            return text[:at] + text[at:to] * chance.randrange(2, 50) + text[to:]
    return text[:to]


def list_text_cases(*, short: bool, seed: int = 1) -> Iterator[Case]:
    """Requests with hostile texts: a sample of them, or all and many mutations."""
    chance = random.Random(seed)
    for form in FORMS:
        texts = list(list_texts(form, seed=seed, mutations=20 if short else 500))
        for route, make in _TARGETS:
            for number, text in enumerate(chance.sample(texts, 4) if short else texts):
                yield Case(route, f"{form} {number}", route.split()[0], route.split()[1], make(text))


def _as_text(text: bytes) -> dict[str, Any]:
    return {"json": {"text": text.decode("utf-8", "replace")[:50_000]}}


def _as_body(text: bytes) -> dict[str, Any]:
    return {"content": text, "headers": {"Content-Type": "application/json"}}


def _as_file(declaration: dict[str, Any], part: str = "declaration") -> Any:
    def make(text: bytes) -> dict[str, Any]:
        return {"files": {"file": ("upload", text)}, "data": {part: json.dumps(declaration)}}

    return make


def _as_context(path_part: str) -> Any:
    def make(text: bytes) -> dict[str, Any]:
        return {"files": {"file": ("upload", b"a,b\n1,2\n"), path_part: (None, text)}}

    return make


def _as_filter(language: str) -> Any:
    def make(text: bytes) -> dict[str, Any]:
        return {"params": {"filter": text.decode("utf-8", "replace")[:6_000], "filter-lang": language}}

    return make


_TARGETS = (
    ("POST /v1/plan-rules", _as_text),
    ("POST /v1/plan-rules", _as_body),
    ("POST /v1/markers", _as_body),
    ("POST /v1/plan-previews", _as_body),
    ("POST /v1/imports", _as_file({"crs": "EPSG:4326", "dry_run": True})),
    ("POST /v1/imports", _as_context("declaration")),
    ("POST /v1/alignments", _as_file({"name": "a"})),
    ("POST /v1/alignments", _as_context("declaration")),
    ("POST /v1/decodes", _as_file({}, "context")),
    ("POST /v1/decodes", _as_context("context")),
    ("GET /ogc/collections/markers/items", _as_filter("cql2-text")),
    ("GET /ogc/collections/markers/items", _as_filter("cql2-json")),
)
"""Every way in which a text reaches a reader: routes with other JSON bodies are in `json_bodies.py`."""

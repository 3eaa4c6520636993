"""Every route x every kind of caller, by real requests; the routes come from the application itself."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa
from fastapi import FastAPI
from starlette.routing import Mount

from app.api.http.dependencies import Caller
from app.api.http.permissions import EVERYBODY, PUBLIC, Permissions
from app.formats.format import SpooledFile
from app.main import create_app
from app.registry.agencies import api_keys
from app.registry.jobs import JobKind, add_job, new_job
from app.registry.reprocessings import reprocessings
from app.registry.vehicles import calibrations
from app.services.access.access import AGENCY_SCOPES, Scope
from app.services.public_pages.reports import SentReport
from app.settings import Settings
from tests.api.health.items import add_test_item
from tests.api.markers.test_cerpm_markers import cerpm
from tests.api.markers.test_codebooks import DESIGN, MEANINGS
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer
from tests.formats.pictures import corner_frame, jpeg, png
from tests.http import PERMISSIONS
from tests.jobs import standin

pytestmark = [pytest.mark.slow, pytest.mark.both_databases]

CALIBRATED: dict[str, Any] = {
    "decoder": "waymark", "summary": "", "rms_px": 0.1, "tilt_spread_deg": 1.0, "views": [],
    "camera": {"width_px": 1, "height_px": 1, "fx_px": 1.0, "fy_px": 1.0, "cx_px": 0.0, "cy_px": 0.0, "distortion": []},
    "sigma": {"fx_px": 1.0, "fy_px": 1.0, "cx_px": 0.0, "cy_px": 0.0, "distortion": []},
    "coverage": {"share": 0.5, "cells": [[1]]},
    "board": {"columns": 7, "rows": 10, "square_mm": 25.0, "marker_mm": 18.0, "dictionary": "DICT_5X5_100"},
}  # fmt: skip
TUS = {"Tus-Resumable": "1.0.0", "Upload-Offset": "0"}
NOBODY_ID = "019cb624-0000-7000-8000-00000000ffff"
UPLOAD = "POST /v1/decodes"
# what a parameter of a path may be where it names no row
FORMS = {
    "annotated": "png",
    "artwork": "svg",
    "board": "svg",
    "layout": "csv",
    "maintenance": "csv",
    "map": "osm",
    "overlay": "png",
    "payload": "json",
    "readings": "csv",
    "track": "csv",
}
VALUES = {
    "version": ("1",),
    "kind": ("geojson",),
    "collection": ("markers",),
    "matrix_set": ("WebMercatorQuad",),
    "zoom": ("0",),
    "row": ("0",),
    "column": ("0",),
    "name": ("bill.csv",),
    "section": ("jobs",),
}
# bodies that are refused for nothing but the row that they are about
BODIES: dict[str, Any] = {
    "POST /v1/plate-drafts/artwork.{form}": {"geometry": {"unit_mm": 1.0}},  # the stand-in decoder reads no drawing
    "PATCH /v1/markers/{marker_id}": {"status": "active"},
    "POST /v1/codebooks/{codebook_id}/entries": {"meanings": [{"kind": "speed-limit-mph", "value": 45}]},
    "PATCH /v1/vehicles/{vehicle_id}": {"note": "seen"},
    "POST /v1/uploads/{upload_id}/complete": {"etags": ["e"]},
    "PUT /v1/vehicles/{vehicle_id}/calibration": {"calibration_id": NOBODY_ID},
    "PATCH /v1/roads/{road_id}": {"calibration": []},
    "PATCH /v1/plans/{plan_id}": {"name": "q"},
    "POST /v1/maintenance/{item_id}/approve": {"outcome": "none"},
    "POST /v1/maintenance/{item_id}/reject": {"reason": "seen"},
    "POST /v1/damage-reports/{report_id}/reject": {"reason": "seen"},
    "POST /v1/roads/{road_id}/locate": {"positions": [[33.501, 43.5]]},
    "POST /v1/roads/{road_id}/position": {"references": [{"measure_m": 10}]},
    "PUT /ogc/collections/{collection}/items/{feature}": {
        "type": "Feature",
        "geometry": {"type": "Point", "coordinates": [9.0, 49.0]},
        "properties": {},
    },
    "PATCH /ogc/collections/{collection}/items/{feature}": {"type": "Feature", "properties": {"status": "active"}},
}
# and such queries
QUERIES = {
    "GET /v1/roads/{road_id}/locate": "?lon=33.501&lat=43.5",
    "GET /v1/roads/{road_id}/position": "?measure_m=10",
}
# what the things made below do not have
NOT_MADE = (
    "/jobs/{job_id}/result",
    "/track.{form}",
    "/artwork.{form}",
    "/proof",
    "/package",
    "/plot.svg",
    "/samples",
    "/packets",
    "/lane.geojson",
    "/overlay.{form}",
)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, new_database_url: Any) -> Iterator[LiveServer]:
    folder: Path = tmp_path_factory.mktemp("permissions") / "var"
    url = new_database_url(folder)
    settings = Settings(data_dir=folder, database_url=url, admin_key=ADMIN_KEY, decode_workers=1, **UNLIMITED)
    with LiveServer(create_app(settings, decode=standin.decode)) as running:
        yield running


def list_routes(app: FastAPI) -> set[str]:
    """Method and path of all that the application answers, HEAD left out; a mount counts as GET."""
    found = set()
    for route in app.routes:
        contexts = route.effective_route_contexts() if hasattr(route, "effective_route_contexts") else [route]
        for context in contexts:
            methods = {"GET"} if isinstance(context, Mount) else context.methods
            found |= {f"{method} {context.path}" for method in methods if method != "HEAD"}
    return found


def fill(path: str, given: dict[str, str]) -> str:
    """A path template with its parameters filled in."""
    return re.sub(r"\{(\w+)\}", lambda found: given[found[1]], path)


def parameters(route: str) -> list[str]:
    return re.findall(r"\{(\w+)\}", route)


def values(route: str) -> dict[str, tuple[str, ...]]:
    """What the parameters of a route may be where they name no row."""
    form = re.search(r"(\w+)\.\{form\}", route)
    return VALUES | ({"form": (FORMS[form[1]],)} if form else {})


def nobodys(route: str) -> dict[str, str]:
    """Parameters of a route about a row that nobody has."""
    known = values(route)
    return {name: known.get(name, (NOBODY_ID,))[0] for name in parameters(route)}


def names_a_row(parameter: str) -> bool:
    return parameter == "feature" or parameter.endswith("_id")


def ask(client: httpx.Client, route: str, path: str) -> httpx.Response:
    """Make a request with a body that fits."""
    method = route.partition(" ")[0]
    headers = {"If-Match": '"1"'}
    if method not in ("POST", "PUT", "PATCH"):
        return client.request(method, path + QUERIES.get(route, ""), headers=headers)
    if route == UPLOAD:
        return client.post(path, content=b"this is no picture", headers={"Content-Type": "image/png"})
    body = json.dumps(BODIES.get(route, {}))
    if path.startswith("/v1/uploads") and not path.endswith("/complete"):
        part = {**TUS, "Content-Type": "application/offset+octet-stream"}
        return client.request(method, path, content=b"x" if method == "PATCH" else b"", headers=headers | part)
    return client.request(method, path, content=body, headers=headers | {"Content-Type": "application/json"})


# --- the table ----------------------------------------------------------------------------------------------------


def test_every_route_is_classified_and_nothing_else(server: LiveServer) -> None:
    routes = list_routes(server.app)
    paths = server.app.openapi()["paths"]
    described = {f"{m.upper()} {path}" for path, ways in paths.items() for m in ways if m != "head"}
    assert described <= routes
    assert routes == set(PERMISSIONS) == set(server.app.state.permissions)


def test_the_table_and_the_router_mean_the_same_route() -> None:
    permissions = Permissions({route: frozenset({route}) for route in PERMISSIONS})  # type: ignore[misc]
    for route in PERMISSIONS:
        method, _, path = route.partition(" ")
        filled = fill(path, nobodys(route))
        assert permissions.find(method, filled) == {route}
        assert permissions.find("HEAD", filled) == permissions.find("GET", filled)
    for path in ("/v1", "/v1/markers/", "/v1/markers/a/b/c", "/v1/marker", "/ogc/x", "/v1/decodes/a/overlay.png/b"):
        assert permissions.find("GET", path) is None
    assert permissions.find("PUT", "/v1/markers") is None


def test_a_route_without_scopes_is_refused_to_all(tmp_path: Path) -> None:
    app = create_app(Settings(data_dir=tmp_path / "var", admin_key=ADMIN_KEY, warm_decoders=False))

    @app.get("/v1/other")
    @app.get("/ogc/other")
    async def get_other(caller: Caller) -> str:
        return caller.label

    with LiveServer(app) as server, server.client() as admin:
        assert admin.get("/v1/other").status_code == 401
        assert admin.get("/ogc/other").status_code == 401
        assert admin.get("/v1/markers").status_code == 200


# --- the matrix ---------------------------------------------------------------------------------------------------

KEYLESS = ("no key", "unknown", "revoked", "expired")


@pytest.fixture(scope="module")
def keys(server: LiveServer) -> dict[str, str | None]:
    """A key of each kind, all of one agency."""
    access = server.app.state.use_cases.access
    made: dict[str, str | None] = {scope: access.create_key("matrix", scope, scope) for scope in AGENCY_SCOPES}
    made[Scope.OPERATOR] = access.create_operator_key("operator")
    made |= {kind: access.create_key("matrix", Scope.ADMIN, kind) for kind in KEYLESS}
    past = datetime.now(UTC) - timedelta(days=1)
    with server.app.state.database.write() as connection:
        for label, change in (("revoked", {"revoked_at": past}), ("expired", {"expires_at": past})):
            connection.execute(sa.update(api_keys).where(api_keys.c.label == label).values(change))
    return made | {"no key": None, "unknown": "a-key-that-nobody-was-given-0000000"}


@pytest.mark.parametrize("kind", [*Scope, *KEYLESS])
def test_every_route_for_each_kind_of_caller(server: LiveServer, keys: dict[str, str | None], kind: str) -> None:
    wrong = []
    with server.client(keys[kind]) as client:
        for route in sorted(list_routes(server.app)):
            allowed, path = PERMISSIONS[route], route.partition(" ")[2]
            answer = ask(client, route, fill(path, nobodys(route)))
            if allowed == PUBLIC:
                # /static leads to /static/; nobody's marker has no page
                expected = answer.status_code in ((404,) if "{marker_id}" in path else (200, 307))
            elif kind in KEYLESS:
                expected = answer.status_code == 401 and "www-authenticate" in answer.headers
            elif kind not in allowed:
                limit = answer.json().get("limit", "")
                expected = answer.status_code == 403 and all(scope in limit for scope in allowed)
            else:
                expected = answer.status_code in (200, 201, 202, 204, 400, 404, 409, 415, 422)
            if not expected:
                wrong.append(f"{route}: {answer.status_code} {answer.text[:200]}")
    assert not wrong, "\n".join(wrong)


def test_a_scope_is_refused_before_the_body_is_read(server: LiveServer, keys: dict[str, str | None]) -> None:
    sent = 0

    def parts() -> Iterator[bytes]:
        nonlocal sent
        for _ in range(256):
            sent += 1
            yield b" " * 65536

    with server.client(keys[Scope.VIEWER]) as viewer:
        try:
            answer = viewer.post("/v1/markers", content=parts(), headers={"Content-Type": "application/json"})
        except httpx.WriteError:
            return  # the server hung up while we were still sending
    assert answer.status_code == 403
    assert answer.headers["connection"] == "close"


# --- the rows of others -------------------------------------------------------------------------------------------


def _made(response: httpx.Response) -> dict[str, Any]:
    assert response.status_code == 201, response.text
    return dict(response.json())


@pytest.fixture(scope="module")
def things(server: LiveServer) -> dict[str, list[str]]:
    """Ids of what one agency has, by the parameter that names it."""
    with server.agency("owners", Scope.ADMIN) as owner:
        place = {"lon_deg": 31.5, "lat_deg": 41.5}
        plate = _made(owner.post("/v1/markers", json={"position": place}))["id"]
        elsewhere = {"position": {"lon_deg": 34.5, "lat_deg": 44.5}, "status": "active"}
        suspect = _made(owner.post("/v1/markers", json=elsewhere))["id"]
        radio = _made(owner.post("/v1/markers", json=cerpm({"lon_deg": 32.5, "lat_deg": 42.5})))["id"]
        way = {"type": "LineString", "coordinates": [[33.5, 43.5], [33.502, 43.5]]}
        line = {"family": "magnet", "lane": {"geometry": way}, "line": {"style": "solid"}}
        magnets = _made(owner.post("/v1/markers", json=line))["id"]
        road = _made(owner.post("/v1/roads", json={"name": "r", "geometry": way}))["id"]
        book = _made(owner.post("/v1/codebooks", json={"name": "b", "design": DESIGN, "meanings": MEANINGS}))
        decode = _made(owner.post("/v1/decodes", content=png(corner_frame()), headers={"Content-Type": "image/png"}))
        vehicle = _made(owner.post("/v1/vehicles", json={"name": "v", "profile": {}}))["id"]
        survey, later = {"file": ("survey.csv", b"lon,lat\n1,2\n")}, {"Prefer": "respond-async"}
        queued = owner.post("/v1/imports", files=survey, headers=later).json()["id"]
        road_file = {
            "file": ("road.geojson", way_file(way), "application/geo+json"),
            "declaration": (None, '{"name": "r"}', "application/json"),
        }
        alignment = _made(owner.post("/v1/alignments", files=road_file))["id"]
        rules = {"version": 1, "plates": {}}
        plan = _made(owner.post("/v1/plans", json={"name": "p", "alignment_id": alignment, "rules": rules}))["id"]
        job = owner.post(f"/v1/plans/{plan}/proof", json={}, headers={"If-Match": "*"}).json()["id"]
        owner.post(f"/v1/jobs/{job}/cancel")
        hook = _made(owner.post("/v1/webhooks", json={"url": "https://example.org/", "events": ["nothing"]}))["id"]
        verification = owner.post("/v1/audit/verifications", json={}).json()["id"]
        upload = owner.post("/v1/uploads", headers={**TUS, "Upload-Length": "9"}).headers["Location"].rsplit("/", 1)[1]
    state = server.app.state
    sent = SentReport("00" * 12, "loose", None, SpooledFile.of(jpeg()), "reporter@example.org", "en")
    report = state.use_cases.damage_reports.submit(state.use_cases.public_pages.read(suspect), sent)
    access = server.app.state.use_cases.access
    caller = access.authenticate(owner.headers["authorization"].split()[1])
    calibration = {"id": "019cb624-0000-7000-8000-00000000cccc", "who": "w", "result": CALIBRATED}
    with server.app.state.database.write() as connection:  # from photos it takes long
        row = {**calibration, "agency_id": caller.agency_id, "created_at": datetime.now(UTC)}
        connection.execute(sa.insert(calibrations).values(row))
        run = {"id": "019cb624-0000-7000-8000-00000000dddd", "who": "w", "criteria": {}, "decodes": 1}
        run |= {"agency_id": caller.agency_id, "created_at": datetime.now(UTC)}
        connection.execute(sa.insert(reprocessings).values(run))
        item = add_test_item(connection, caller.agency_id, suspect)
        drive = new_job(
            JobKind.DRIVE, "019cb624-0000-7000-8000-00000000dddd", caller.agency_id, caller.key_id, datetime.now(UTC),
            job_input={"name": None, "decodes": [], "options": {}, "label": "l"},
        )  # fmt: skip
        add_job(connection, drive._replace(state="cancelled"))
    return {
        "item_id": [item],
        "report_id": [report],
        "calibration_id": [calibration["id"]],
        "road_id": [road],
        "vehicle_id": [vehicle],
        "key_id": [caller.key_id],
        "marker_id": [plate, magnets, radio],
        "feature": [plate],
        "codebook_id": [book["id"]],
        "code": [book["entries"][0]["code"]],
        "decode_id": [decode["id"]],
        "drive_id": [drive.id],
        "alignment_id": [alignment],
        "plan_id": [plan],
        "job_id": [job, queued, verification],
        "upload_id": [upload],
        "webhook_id": [hook],
        "reprocessing_id": [str(run["id"])],
        "delivery_id": [NOBODY_ID],
    }


def way_file(way: dict[str, Any]) -> bytes:
    """A road file of one line."""
    feature = {"type": "Feature", "properties": {"speed_limit_kmh": 50}, "geometry": way}
    return json.dumps({"type": "FeatureCollection", "features": [feature]}).encode()


def _paths(route: str, things: dict[str, list[str]]) -> Iterator[tuple[str, str]]:
    """Paths of a route about each of the things, and about things that nobody has."""
    path, names = route.partition(" ")[2], parameters(route)
    known: dict[str, Any] = values(route) | things
    missing = [name for name in names if name not in known]
    assert not missing, f"{route}: make a row for {missing} in `things`, or say in VALUES what it may be"
    for chosen in itertools.product(*(known[name] for name in names)):
        real = dict(zip(names, chosen, strict=True))
        yield fill(path, real), fill(path, {n: NOBODY_ID if names_a_row(n) else value for n, value in real.items()})


def _same_for(response: httpx.Response, path: str) -> str:
    """The body, without what tells two requests apart anyway."""
    body = re.sub(r'"request_id":\s*"\w+"', "", response.text)
    for segment in path.split("/"):
        if len(segment) >= 36:
            body = body.replace(segment[:36], "ID")
    return body


@pytest.fixture(scope="module")
def stranger(server: LiveServer) -> Iterator[httpx.Client]:
    with server.agency("strangers to everything", Scope.ADMIN) as client:
        yield client


ABOUT_ROWS = sorted(
    route for route, allowed in PERMISSIONS.items() if allowed != PUBLIC and any(map(names_a_row, parameters(route)))
)


@pytest.mark.parametrize("route", ABOUT_ROWS)
def test_a_row_of_another_agency_is_as_if_it_were_not_there(
    stranger: httpx.Client, things: dict[str, list[str]], route: str
) -> None:
    for theirs, nobodys in _paths(route, things):
        answers = [ask(stranger, route, path) for path in (theirs, nobodys)]
        if route.startswith("OPTIONS"):
            assert {answer.status_code for answer in answers} == {200}
            continue
        assert [a.status_code for a in answers] == [404, 404], f"{route}: {answers[0].text} {answers[1].text}"
        if route.startswith("GET"):  # not even that it has not changed
            assert stranger.get(theirs + QUERIES.get(route, ""), headers={"If-None-Match": '"1"'}).status_code == 404
        assert _same_for(answers[0], theirs) == _same_for(answers[1], nobodys)


@pytest.mark.parametrize(
    "route", [route for route in ABOUT_ROWS if route.startswith("GET") and not route.endswith(NOT_MADE)]
)
def test_and_its_owner_finds_it(server: LiveServer, things: dict[str, list[str]], route: str) -> None:
    with server.agency("owners", Scope.ADMIN) as owner:
        answers = [ask(owner, route, path) for path, _ in _paths(route, things)]
    assert any(answer.status_code == 200 for answer in answers), [answer.text for answer in answers]


# requests whose bodies or queries name rows: the kind of row, and the request about a row with an id
WAY = {"type": "LineString", "coordinates": [[34.5, 44.5], [34.503, 44.5]]}
MENTIONS: dict[str, tuple[str, Callable[[str], dict[str, Any]]]] = {
    "POST /v1/artwork": ("marker_id", lambda row: {"json": {"marker_ids": [row]}}),
    "POST /v1/programs": ("marker_id", lambda row: {"json": {"marker_ids": [row]}}),
    "POST /v1/markers/bulk": (
        "marker_id",
        lambda row: {"json": {"items": [{"update": {"id": row, "version": 1, "change": {"status": "active"}}}]}},
    ),
    "POST /v1/markers": (
        "codebook_id",
        lambda row: {
            "json": {
                "family": "magnet",
                "lane": {"geometry": WAY},
                "tag": {"codebook_id": row, "chainage_m": 50, "meaning": MEANINGS[0]},
            }
        },
    ),
    "POST /v1/alignments": (
        "road_id",
        lambda row: {"json": {"name": "x", "road_id": row, "lanes": {"forward": 1, "width_m": 3.5}}},
    ),
    "POST /v1/plans": (
        "alignment_id",
        lambda row: {"json": {"name": "x", "alignment_id": row, "rules": {"version": 1, "plates": {}}}},
    ),
    "POST /v1/plan-previews": (
        "alignment_id",
        lambda row: {"json": {"alignment_id": row, "rules": {"version": 1, "plates": {}}}},
    ),
    "POST /v1/vehicles": ("calibration_id", lambda row: {"json": {"name": f"v {row}", "profile": _camera(row)}}),
    "PATCH /v1/vehicles/{vehicle_id}": ("calibration_id", lambda row: {"json": {"profile": _camera(row)}}),
    "PUT /v1/vehicles/{vehicle_id}/calibration": ("calibration_id", lambda row: {"json": {"calibration_id": row}}),
    "PUT /v1/vehicles/{vehicle_id}/keys/{key_id}": ("key_id", lambda _row: {}),
    "POST /v1/reprocessings": ("vehicle_id", lambda row: {"json": {"vehicle_id": row}}),
    "POST /v1/decodes": (
        "vehicle_id",
        lambda row: {
            "content": png(corner_frame()),
            "headers": {"Content-Type": "image/png", "Waymark-Context": json.dumps({"vehicle": row})},
        },
    ),
    "GET /v1/damage-reports": ("marker_id", lambda row: {"params": {"marker_id": row}}),
    "POST /v1/print-grades": (
        "marker_id",
        lambda row: {
            "files": {
                "photo": ("plate.png", png(corner_frame())),
                "declaration": (None, json.dumps({"marker_id": row})),
            }
        },
    ),
    "GET /v1/plans": ("alignment_id", lambda row: {"params": {"alignment_id": row}}),
    "GET /v1/maintenance": ("marker_id", lambda row: {"params": {"marker_id": row}}),
    "GET /v1/maintenance.{form}": ("marker_id", lambda row: {"params": {"marker_id": row}}),
    "GET /v1/jobs": ("plan_id", lambda row: {"params": {"subject_id": row}}),
    "GET /ogc/collections/plans/items": ("plan_id", lambda row: {"params": {"plan_id": row}}),
    "GET /ogc/collections/alignments/items": ("alignment_id", lambda row: {"params": {"alignment_id": row}}),
}
NOT_ROWS = {"arbitration_id", "id"}  # of CAN frames; of a GeoJSON feature, whose path names it


def _camera(calibration_id: str) -> dict[str, Any]:
    return {"camera": {**CALIBRATED["camera"], "calibration_id": calibration_id}}


@pytest.mark.parametrize("route", MENTIONS)
def test_ids_in_bodies_and_queries_are_as_if_they_were_not_there(
    stranger: httpx.Client, things: dict[str, list[str]], route: str
) -> None:
    method, _, path = route.partition(" ")
    kind, request = MENTIONS[route]
    if "{vehicle_id}" in path:
        made = _made(stranger.post("/v1/vehicles", json={"name": route, "profile": {}}))
        path, etag = path.replace("{vehicle_id}", made["id"]), {"If-Match": '"1"'}
    else:
        etag = {}
    for theirs in things[kind]:
        answers = []
        for row in (theirs, NOBODY_ID):
            asked = request(row)
            asked["headers"] = {**etag, **asked.get("headers", {})}
            full = path.replace("{key_id}", row).replace("{form}", "geojson")
            answers.append(stranger.request(method, full, **asked))
        assert answers[0].status_code == answers[1].status_code, [answer.text for answer in answers]
        bodies = [re.sub(r'"request_id":"\w+"|"(href|timeStamp)":\s*"[^"]*"', "", answer.text) for answer in answers]
        assert bodies[0].replace(theirs, NOBODY_ID) == bodies[1]
        if method != "GET":
            assert answers[0].status_code in (404, 422), answers[0].text
        else:
            assert '"items":[]' in bodies[0] or '"features":[]' in bodies[0]


def test_every_id_in_a_body_or_a_query_is_asked_about(server: LiveServer) -> None:
    document = server.app.openapi()
    schemas = document["components"]["schemas"]

    def named(schema: dict[str, Any], seen: frozenset[str]) -> Iterator[str]:
        reference = schema.get("$ref", "").rpartition("/")[2]
        if reference in seen:
            return
        schema = schemas[reference] if reference else schema
        yield from schema.get("properties", {})
        inner = [*schema.get("properties", {}).values(), schema.get("items", {})]
        for part in (*inner, *(one for how in ("anyOf", "oneOf", "allOf") for one in schema.get(how, ()))):
            if isinstance(part, dict) and part:
                yield from named(part, seen | {reference} if reference else seen)

    missing = set()
    for path, ways in document["paths"].items():
        for method, way in ways.items():
            content = way.get("requestBody", {}).get("content", {}).values()
            names = {name for kind in content for name in named(kind["schema"], frozenset())}
            names |= {parameter["name"] for parameter in way.get("parameters", ()) if parameter["in"] == "query"}
            if any(re.search(r"(^|_)ids?$", name) and name not in NOT_ROWS for name in names):
                missing.add(f"{method.upper()} {path}")
    missing.discard("GET /ogc/collections/{collection}/items")  # two collections above
    assert missing <= set(MENTIONS), "say in MENTIONS how a request names a row of another agency"


def test_vehicles_see_their_own_decodes_only(server: LiveServer) -> None:
    with (
        server.agency("fleet", Scope.VEHICLE) as one,
        server.agency("fleet", Scope.VEHICLE) as other,
        server.agency("fleet", Scope.VIEWER) as viewer,
    ):
        upload = {"content": png(corner_frame()), "headers": {"Content-Type": "image/png"}}
        mine, theirs = (_made(vehicle.post("/v1/decodes", **upload))["id"] for vehicle in (one, other))
        assert [item["id"] for item in one.get("/v1/decodes").json()["items"]] == [mine]
        assert {item["id"] for item in viewer.get("/v1/decodes").json()["items"]} == {mine, theirs}
        for route, allowed in PERMISSIONS.items():
            if "{decode_id}" not in route or allowed < EVERYBODY - {Scope.VIEWER}:
                continue
            path = fill(route.partition(" ")[2], {**nobodys(route), "decode_id": "{decode_id}"})
            answers = [ask(one, route, path.replace("{decode_id}", decode)) for decode in (theirs, NOBODY_ID)]
            assert [answer.status_code for answer in answers] == [404, 404], route
            bodies = [re.sub(r'"request_id":"\w+"', "", answer.text) for answer in answers]
            assert bodies[0].replace(theirs, NOBODY_ID) == bodies[1]

"""Vehicles drive past a plate that was moved and one that is gone: the work list has exactly these two."""

from __future__ import annotations

from typing import Any

import httpx
import numpy as np
import pytest
import sqlalchemy as sa

from app.geodesy import enu_from_heading, enu_from_wgs84, wgs84_from_enu
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.registry.health import marker_health
from app.sensors.camera import Camera
from app.services.health.record import recompute_health
from app.simulation.camera import render_plate_scene
from app.simulation.plate_face import PlateWear, draw_look, plate_face
from app.simulation.plate_scene import PlacedFace, PlateScene
from tests.api.decodes.conftest import post_frame
from tests.conftest import LiveServer

CAMERA_IN = {"width_px": 960, "height_px": 540, "horizontal_fov_deg": 60.0, "height_m": 1.4, "depression_deg": 20.0}
CAMERA = Camera.from_field_of_view(960, 540, 60.0, height_m=1.4, depression_deg=20.0)
ORIGIN, HEADING_DEG, SPACING_M = (21.3, 52.2, 100.0), 63.0, 30.0
AHEAD_M = 4.0
MOVED, GONE, PLATES = 1, 2, 4
FEW, MANY = 5, 60
"""Vehicles that pass all plates, and vehicles that may be needed for the one that is gone: it might be dirty."""


def _place(forward_m: float, left_m: float = 0.0) -> tuple[float, float]:
    enu = enu_from_heading(HEADING_DEG) @ np.array([-left_m, forward_m, 0.0])
    lon, lat, _height = wgs84_from_enu(enu, ORIGIN)
    return float(lon), float(lat)


def _register(client: httpx.Client) -> list[dict[str, Any]]:
    markers = []
    for number in range(PLATES):
        lon, lat = _place(number * SPACING_M + AHEAD_M)
        position = {
            "lon_deg": lon, "lat_deg": lat, "realization": "ITRF2014", "epoch": 2026.4, "horizontal_rmse_m": 0.02,
        }  # fmt: skip
        body = {"position": position, "heading_deg": HEADING_DEG, "status": "active", "code": {"scheme": "id"}}
        answer = client.post("/v1/markers", json=body)
        assert answer.status_code == 201, answer.text
        markers.append(answer.json())
    return markers


def _frame(marker: dict[str, Any] | None, ahead_m: float, seed: int) -> bytes:
    """What the camera sees of the road ahead; None: no plate is there."""
    rng = np.random.default_rng(seed)
    faces: tuple[PlacedFace, ...] = ()
    if marker is not None:
        code = PlateCode(marker["code"]["digits"], PlateScheme.ID, marker["geometry"]["n"])
        face = plate_face(code, PlateGeometry(n=code.n), draw_look(rng), PlateWear(), rng)
        faces = (PlacedFace(face, ahead_m, 0.0, 0.0),)
    jpeg = render_plate_scene(PlateScene(camera=CAMERA, faces=faces), None, rng).jpeg
    assert jpeg
    return jpeg


def _pass(client: httpx.Client, frames: list[bytes], vehicle: str, rng: np.random.Generator) -> None:
    """One vehicle drives past all plates, with a shift of its own."""
    assert client.post("/v1/vehicles", json={"name": vehicle, "profile": {}}).status_code == 201
    shift = rng.normal(0.0, 0.1, 2)
    for number, frame in enumerate(frames):
        lon, lat = _place(number * SPACING_M + shift[0] + rng.normal(0, 0.02), shift[1] + rng.normal(0, 0.02))
        context = {
            "coarse_position": {"lon_deg": lon, "lat_deg": lat, "accuracy_m": 0.15}, "heading_deg": HEADING_DEG,
            "camera": CAMERA_IN, "captured_at": f"2026-05-27T{8 + number // 60:02d}:{number % 60:02d}:00Z",
            "vehicle": vehicle,
        }  # fmt: skip
        answer = post_frame(client, frame, context)
        assert answer.status_code == 201, answer.text


def _found(client: httpx.Client) -> dict[str, str]:
    items = client.get("/v1/maintenance").json()["items"]
    return {item["marker_id"]: item["what"] for item in items}


@pytest.mark.slow
def test_a_plate_that_moved_and_one_that_is_gone_are_the_work_list(real_server: LiveServer) -> None:
    with real_server.agency("health agency") as client:
        markers, rng = _register(client), np.random.default_rng(7)
        there: list[dict[str, Any] | None] = list(markers)
        there[GONE] = None
        ahead = [AHEAD_M + (1.5 if number == MOVED else 0.0) for number in range(PLATES)]
        frames = [_frame(marker, ahead[k], 40 + k) for k, marker in enumerate(there)]
        _pass(client, frames, "v0", rng)
        _pass(client, frames, "v1", rng)
        assert _found(client) == {}  # two vehicles are not enough
        for number in range(2, FEW):
            _pass(client, frames, f"v{number}", rng)
        assert _found(client) == {markers[MOVED]["id"]: "moved"}
        number = FEW
        while markers[GONE]["id"] not in _found(client) and number < MANY:
            _pass(client, frames, f"v{number}", rng)
            number += 1
        assert _found(client) == {markers[MOVED]["id"]: "moved", markers[GONE]["id"]: "missing"}
        item = client.get("/v1/maintenance", params={"what": "moved"}).json()["items"][0]
        _check_offset(item)
        assert client.get(item["evidence"]["uploads"][0]["picture"]).status_code == 200
        assert {client.get(f"/v1/markers/{marker['id']}").json()["status"] for marker in markers} == {"active"}
        observed = client.get(f"/v1/markers/{markers[GONE]['id']}/observations").json()["items"]
        assert {one["what"] for one in observed} == {"missed"}
        _check_recomputed(real_server, client)


def _check_offset(item: dict[str, Any]) -> None:
    evidence = item["evidence"]
    lon, lat = _place(1.5)
    east, north, _up = enu_from_wgs84(lon, lat, ORIGIN[2], ORIGIN)
    assert (evidence["offset_east_m"], evidence["offset_north_m"]) == pytest.approx((east, north), abs=0.25)


def _check_recomputed(server: LiveServer, client: httpx.Client) -> None:
    """The states that grew with the uploads are those that follow from the stored observations."""
    key = client.headers["authorization"].split()[1]
    agency_id = server.app.state.use_cases.access.authenticate(key).agency_id
    columns = marker_health.c
    query = sa.select(columns.subject, columns.passes, columns.ratios, columns.state).order_by(columns.subject)
    with server.app.state.database.write() as connection:
        grown = connection.execute(query.where(columns.agency_id == agency_id)).all()
        recompute_health(connection, agency_id, server.app.state.use_cases.maintenance._clock())
        again = connection.execute(query.where(columns.agency_id == agency_id)).all()
    assert grown == again
    assert len(grown) > PLATES

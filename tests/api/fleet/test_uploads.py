"""A vehicle sends the file and little else: its profile, its keys and what it did, on both databases."""

from __future__ import annotations

import io
import itertools
import json
import zipfile
from collections.abc import Iterator
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from app.demo.cerpms import BuiltLane, build_lane
from app.services.access.access import Scope
from app.simulation.magnetic.recorder import write_recorder_files
from tests.api.decodes.test_archives import wait_for
from tests.api.decodes.test_packets import drive, packed
from tests.api.decodes.test_road import CAMERA_IN, Road
from tests.api.decodes.test_traces import Place, _drive, _zipped
from tests.conftest import LiveServer
from tests.http import refused

pytestmark = pytest.mark.both_databases

PLATE_AT = {"lon_deg": 114.1712, "lat_deg": 22.3031}
_AGENCIES = itertools.count(1)


@pytest.fixture
def fleet(server: LiveServer) -> Iterator[httpx.Client]:
    """A client of an agency that only this test uses, with time for the first frame."""
    with server.agency(f"fleet {next(_AGENCIES)}", Scope.ADMIN) as client:
        client.timeout = httpx.Timeout(280)
        yield client


def _vehicle(client: httpx.Client, name: str = "BUS-7", **profile: Any) -> dict[str, Any]:
    answer = client.post("/v1/vehicles", json={"name": name, "profile": profile})
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def _state(client: httpx.Client, vehicle: dict[str, Any]) -> dict[str, Any]:
    return dict(client.get(f"/v1/vehicles/{vehicle['id']}").json())


def _send(client: httpx.Client, data: bytes, context: Any = None, name: str = "upload", **more: Any) -> httpx.Response:
    parts: dict[str, Any] = {"file": (name, data, "application/octet-stream")}
    if context is not None:
        parts["context"] = (None, json.dumps(context), "application/json")
    if "vehicle" in more:
        parts["vehicle"] = (None, more.pop("vehicle"))
    return client.post("/v1/decodes", files=parts, headers=more)


def _grey_png(width: int = 96, height: int = 64) -> bytes:
    return bytes(cv2.imencode(".png", np.full((height, width), 90, np.uint8))[1])


# --- the file and little else -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_frame_with_the_vehicles_name_gives_its_position(fleet: httpx.Client) -> None:
    road = Road(fleet, PLATE_AT, (5.0, 0.3, 4.0)).register()
    vehicle = _vehicle(fleet, camera=CAMERA_IN)
    known = {name: road.context()[name] for name in ("coarse_position", "captured_at")}
    answer = _send(fleet, road.frame(), {"vehicle": "BUS-7", **known})
    assert answer.status_code == 201, answer.text
    decode = answer.json()
    assert road.error_m(decode["fix"]) < 0.15
    used = decode["context"]["vehicle"]
    assert (used["id"], used["name"], used["version"]) == (vehicle["id"], "BUS-7", 1)
    assert used["sources"]["camera.forward_m"] == "vehicle"
    assert used["sources"]["camera.roll_deg"] == "default"
    assert used["sources"]["coarse_position.lon_deg"] == "upload"
    # the same as if the upload had said it all
    whole = _send(fleet, road.frame(), road.context()).json()
    assert whole["fix"] == decode["fix"]
    assert "vehicle" not in whole["context"]
    assert whole["context"]["camera"] == decode["context"]["camera"]
    state = _state(fleet, vehicle)
    assert (state["uploads"], state["driven_km"], state["version"]) == (1, 0.0, 1)
    assert state["last_seen_at"] >= vehicle["created_at"]


def test_a_trace_with_the_vehicles_name_gives_tags_and_kilometres(fleet: httpx.Client) -> None:
    place = Place(fleet)
    _vehicle(fleet, trace={"bar": {"forward_m": 0.0}, "rate_hz": 350.0}, camera=CAMERA_IN)
    recording = _zipped(write_recorder_files(_drive().trace))
    context = {"vehicle": "BUS-7", "coarse_position": place.context["coarse_position"]}
    first = _send(fleet, recording, context, "drive.zip", **{"Idempotency-Key": "drive one"})
    assert first.status_code == 201, first.text
    decode = first.json()
    assert [tag["match"]["marker_id"] for tag in decode["tags"]] == place.ids
    assert decode["context"]["vehicle"]["sources"]["trace.rate_hz"] == "vehicle"
    assert "camera" not in decode["context"]
    again = _send(fleet, recording, context, "drive.zip", **{"Idempotency-Key": "drive one"})
    assert again.headers["idempotency-replayed"] == "true"
    [state] = fleet.get("/v1/vehicles").json()["items"]
    assert state["uploads"] == 1
    assert state["driven_km"] == pytest.approx(decode["report"]["driven_m"] / 1000, abs=6e-4)
    assert state["driven_km"] == pytest.approx(0.11, abs=0.005)


@pytest.fixture
def lane(fleet: httpx.Client) -> BuiltLane:
    """Markers along the demo's lane."""
    return build_lane(fleet, np.random.default_rng(1901))


def test_a_packet_log_with_the_vehicles_name_gives_the_lane_and_kilometres(
    fleet: httpx.Client, lane: BuiltLane
) -> None:
    heard, _hour = drive(lane, 1902)
    receiver = {"sensitivity_dbm": -120.0, "antenna_height_m": 2.0}
    vehicle = _vehicle(fleet, packets={"receiver": receiver, "steering": "none"}, trace={}, camera={"height_m": 1.4})
    answer = _send(fleet, packed(heard), vehicle="BUS-7", name="drive.zip")
    assert answer.status_code == 201, answer.text
    decode = answer.json()
    assert decode["kind"] == "packets"
    assert decode["lane"]["refusal"] is None
    assert decode["steering"] is None
    assert decode["context"]["vehicle"]["sources"]["packets.receiver.antenna_height_m"] == "vehicle"
    nearest_m = min(marker["rssi_profile"]["distance_m"][0] for marker in decode["markers"])
    assert nearest_m > 2.0  # the antenna's height is part of the distance
    state = _state(fleet, vehicle)
    assert state["uploads"] == 1
    assert state["driven_km"] == pytest.approx(decode["report"]["driven_m"] / 1000, abs=6e-4)
    driven_m = float(np.hypot(*np.diff(heard.drive.point_m, axis=0).T).sum())
    assert decode["report"]["driven_m"] == pytest.approx(driven_m, rel=0.02)


def test_frames_of_a_drive_count_what_lies_between_their_positions(fleet: httpx.Client) -> None:
    vehicle = _vehicle(fleet, camera=CAMERA_IN)
    packed_frames, coarse = io.BytesIO(), None
    with zipfile.ZipFile(packed_frames, "w") as archive:
        for k in range(2):
            at = {"lon_deg": PLATE_AT["lon_deg"] + 0.3 + k * 2e-4, "lat_deg": PLATE_AT["lat_deg"]}
            road = Road(fleet, at, (5.0, 0.3, 4.0)).register()
            coarse = coarse or {**road.context()["coarse_position"], "accuracy_m": 60.0}
            archive.writestr(f"{k}.jpg", road.frame(seed=k))
    answer = _send(fleet, packed_frames.getvalue(), {"vehicle": vehicle["id"], "coarse_position": coarse})
    assert answer.status_code == 202, answer.text
    assert _state(fleet, vehicle)["uploads"] == 1
    done = wait_for(fleet, answer.headers["location"])
    assert done["summary"]["fixes"] == 2, done["summary"]
    assert _state(fleet, vehicle)["driven_km"] == pytest.approx(0.0206, abs=0.001)


# --- what the upload states goes first ----------------------------------------------------------------------------


def test_what_the_upload_states_overrides_field_by_field(fleet: httpx.Client) -> None:
    camera = {
        "width_px": 96, "height_px": 64, "fx_px": 80.0, "fy_px": 80.0, "cx_px": 47.5, "cy_px": 31.5,
        "distortion": [-0.1, 0.0, 0.0, 0.0], "height_m": 1.4, "depression_deg": 10.0, "readout_s": 0.02,
    }  # fmt: skip
    vehicle = _vehicle(fleet, camera=camera)
    patch = {"profile": {"camera": camera | {"height_m": 1.45}}}
    assert fleet.patch(f"/v1/vehicles/{vehicle['id']}", json=patch, headers={"If-Match": '"1"'}).status_code == 200
    stated = {"vehicle": "BUS-7", "camera": {"depression_deg": 12.0}, "heading_deg": 10.0}
    decode = _send(fleet, _grey_png(), stated).json()
    used, kept = decode["context"]["vehicle"], decode["context"]["camera"]
    assert used["version"] == 2
    assert (kept["height_m"], kept["depression_deg"], kept["fx_px"]) == (1.45, 12.0, 80.0)
    assert kept["readout_s"] == 0.02
    sources = used["sources"]
    assert sources["camera.depression_deg"] == sources["heading_deg"] == "upload"
    assert sources["camera.height_m"] == sources["camera.distortion"] == "vehicle"
    assert sources["camera.azimuth_deg"] == "default"
    # another field of view takes the intrinsics' place, the mount stays
    wide = _send(fleet, _grey_png(), {"vehicle": "BUS-7", "camera": {"horizontal_fov_deg": 90.0}}).json()["context"]
    assert "fx_px" not in wide["camera"]
    assert wide["camera"]["height_m"] == 1.45
    # and so do intrinsics of another size of frame
    other = {"width_px": 48, "height_px": 32, "fx_px": 40.0, "fy_px": 40.0, "cx_px": 23.5, "cy_px": 15.5}
    small = _send(fleet, _grey_png(48, 32), {"vehicle": "BUS-7", "camera": other}).json()["context"]
    assert "distortion" not in small["camera"]
    assert small["vehicle"]["sources"]["camera.fx_px"] == "upload"
    # null says that it is not known: nothing is inherited
    blind = _send(fleet, _grey_png(), {"vehicle": "BUS-7", "camera": None}).json()["context"]
    assert "camera" not in blind


def test_intrinsics_are_of_one_size_of_frame(fleet: httpx.Client) -> None:
    camera = {"width_px": 96, "height_px": 64, "fx_px": 80.0, "fy_px": 80.0, "cx_px": 47.5, "cy_px": 31.5}
    vehicle = _vehicle(fleet, camera=camera)
    refused(_send(fleet, _grey_png(48, 32), vehicle="BUS-7"), 422, "invalid-parameter", field="camera.width_px")
    said = {"vehicle": "BUS-7", "camera": {"width_px": 48, "height_px": 32}}
    refused(_send(fleet, _grey_png(48, 32), said), 422, "invalid-parameter", field="camera.width_px")
    assert _state(fleet, vehicle)["uploads"] == 0


# --- refusals -----------------------------------------------------------------------------------------------------


def test_a_vehicle_that_cannot_be_used_is_refused_and_nothing_counted(server: LiveServer, fleet: httpx.Client) -> None:
    vehicle = _vehicle(fleet, camera=CAMERA_IN)
    picture = _grey_png()
    unknown = refused(_send(fleet, picture, {"vehicle": "BUS-8"}), 404, "not-found", field="vehicle")
    with server.agency(f"strangers {next(_AGENCIES)}") as stranger:
        theirs = refused(_send(stranger, picture, {"vehicle": "BUS-7"}), 404, "not-found", field="vehicle")
        assert theirs["detail"] == unknown["detail"].replace("BUS-8", "BUS-7")
        by_id = refused(_send(stranger, picture, {"vehicle": vehicle["id"]}), 404, "not-found", field="vehicle")
        assert vehicle["name"] not in by_id["detail"]
    bare = _vehicle(fleet, "BARE")
    lacking = refused(_send(fleet, picture, {"vehicle": "BARE"}), 422, "invalid-parameter", field="vehicle")
    assert "no camera" in lacking["detail"]
    refused(_send(fleet, b"t_s,s1_x\n0,1\n", {"vehicle": "BUS-7"}), 422, "invalid-parameter", field="vehicle")
    _vehicle(fleet, "MOUNTED", camera={"height_m": 1.4})
    mounted = refused(_send(fleet, picture, {"vehicle": "MOUNTED"}), 422, "invalid-parameter", field="vehicle")
    assert "calibrat" in mounted["cure"]
    unclear = refused(_send(fleet, b"what is this", {"vehicle": "BARE"}), 422, "invalid-parameter", field="vehicle")
    assert "no trace" in unclear["detail"]
    assert fleet.delete(f"/v1/vehicles/{vehicle['id']}", headers={"If-Match": '"1"'}).status_code == 204
    refused(_send(fleet, picture, {"vehicle": "BUS-7"}), 409, "conflict", field="vehicle")
    assert [v["uploads"] for v in fleet.get("/v1/vehicles").json()["items"]] == [0, 0, 0]
    assert fleet.get("/v1/decodes").json() == {"items": []}
    assert _state(fleet, bare)["last_seen_at"] is None


@pytest.mark.parametrize("name", ["", "x" * 81, "a\x00b", 7, ["BUS-7"], "\ud800"])
def test_a_bad_name_is_a_problem(fleet: httpx.Client, name: Any) -> None:
    answer = _send(fleet, _grey_png(), {"vehicle": name})
    assert answer.status_code in (400, 422), answer.text
    assert answer.json()["field"].endswith("vehicle")
    if isinstance(name, str) and name and "\ud800" not in name:
        assert _send(fleet, _grey_png(), vehicle=name).status_code in (400, 422)


def test_form_and_context_name_the_same_vehicle(fleet: httpx.Client) -> None:
    _vehicle(fleet, camera=CAMERA_IN | {"width_px": 96, "height_px": 64})
    assert _send(fleet, _grey_png(), {"vehicle": "BUS-7"}, vehicle="BUS-7").status_code == 201
    refused(_send(fleet, _grey_png(), {"vehicle": "BUS-7"}, vehicle="BUS-8"), 400, "malformed-request", field="vehicle")
    key = {"Idempotency-Key": "k"}
    assert _send(fleet, _grey_png(), vehicle="BUS-7", **key).status_code == 201
    refused(_send(fleet, _grey_png(), **key), 409, "idempotency-conflict", field="Idempotency-Key")


def test_a_key_speaks_for_its_vehicle(server: LiveServer) -> None:
    agency = f"keyed {next(_AGENCIES)}"
    camera = CAMERA_IN | {"width_px": 96, "height_px": 64}
    with server.agency(agency, Scope.ADMIN) as admin, server.agency(agency, Scope.VEHICLE) as on_board:
        mine, other = _vehicle(admin, "A", camera=camera), _vehicle(admin, "B", camera=camera)
        key_id = server.app.state.use_cases.access.authenticate(on_board.headers["authorization"].split()[1]).key_id
        assert "vehicle" not in _send(on_board, _grey_png()).json()["context"]
        path = f"/v1/vehicles/{mine['id']}/keys/{key_id}"
        assert admin.put(path).status_code == 200
        assert _send(on_board, _grey_png()).json()["context"]["vehicle"]["name"] == "A"
        assert _send(on_board, _grey_png(), {"vehicle": "A"}).status_code == 201
        refused(_send(on_board, _grey_png(), {"vehicle": "B"}), 403, "not-allowed", field="vehicle")
        assert (_state(admin, mine)["uploads"], _state(admin, other)["uploads"]) == (2, 0)
        assert on_board.get("/v1/vehicles").status_code == 403
        admin.delete(f"/v1/vehicles/{mine['id']}", headers={"If-Match": "*"})
        refused(_send(on_board, _grey_png()), 409, "conflict", field="vehicle")
        assert admin.delete(path).status_code == 204
        assert "vehicle" not in _send(on_board, _grey_png()).json()["context"]

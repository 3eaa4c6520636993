"""What CERPMs send and are programmed with, over HTTP."""

from __future__ import annotations

import csv
import io
from typing import Any

import httpx
import pytest

from app.decoders.cerpm.verify import decode_message, has_valid_tag
from app.errors import Unavailable
from app.markers.cerpm import LaneSide
from app.registry.agencies import find_first_agency
from app.registry.database import Database
from app.services.access.access import Scope
from app.services.access.agency_secrets import AgencySecrets
from app.settings import Settings
from tests.api.markers.test_cerpm_markers import cerpm
from tests.conftest import LiveServer, Place


@pytest.fixture
def marker(client: httpx.Client, place: Place) -> dict[str, Any]:
    """A registered CERPM."""
    body = cerpm(place(), side="right", speed_limit={"value": 25, "unit": "mph"}, status="surveyed")
    made: dict[str, Any] = client.post("/v1/markers", json=body).json()
    return made


def test_the_payload_says_what_is_registered(client: httpx.Client, marker: dict[str, Any]) -> None:
    head = f"/v1/markers/{marker['id']}/payload"
    sent = client.get(f"{head}.bin").content
    message, _tag = decode_message(sent)
    assert len(sent) == 24
    assert message.number == marker["code"]["number"]
    assert message.lon_deg == pytest.approx(marker["position"]["lon_deg"], abs=5.1e-8)
    assert message.lat_deg == pytest.approx(marker["position"]["lat_deg"], abs=5.1e-8)
    assert message.side is LaneSide.RIGHT
    assert message.sequence == 0
    assert message.speed_limit is not None
    assert (message.speed_limit.value, message.speed_limit.unit) == (25, "mph")
    told = client.get(f"{head}.json").json()
    assert told["hex"] == sent.hex()
    assert sum(part["length"] for part in told["bytes"]) == 24
    assert "25 mph" in client.get(f"{head}.hex").text
    assert "the marker's own" in client.get(f"{head}.hex").text
    later = client.get(f"{head}.bin", params={"sequence": 77}).content
    assert decode_message(later)[0].sequence == 77
    assert later[20:] != sent[20:]


def test_keys_come_only_to_an_admin_and_fit_the_tags(
    server: LiveServer, client: httpx.Client, marker: dict[str, Any]
) -> None:
    wanted = {"marker_ids": [marker["id"]]}
    table = client.post("/v1/programs", json=wanted)
    assert table.status_code == 200, table.text
    assert table.headers["content-type"].startswith("text/csv")
    row = next(csv.DictReader(io.StringIO(table.text)))
    assert row["number"] == str(marker["code"]["number"])
    assert "key_hex" not in row
    sent = client.get(f"/v1/markers/{marker['id']}/payload.bin").content
    assert row["body_hex"] == sent[:20].hex()
    refused = client.post("/v1/programs", json={**wanted, "with_keys": True})
    assert refused.status_code == 403


def test_an_admin_gets_the_key_of_each_marker(server: LiveServer, place: Place) -> None:
    with server.client() as admin:
        made = admin.post("/v1/markers", json=cerpm(place())).json()
        wanted = {"marker_ids": [made["id"]], "with_keys": True}
        row = next(csv.DictReader(io.StringIO(admin.post("/v1/programs", json=wanted).text)))
        sent = admin.get(f"/v1/markers/{made['id']}/payload.bin").content
        assert has_valid_tag(sent, bytes.fromhex(row["key_hex"]))


def test_readers_and_vehicles_cannot_speak_for_a_marker(
    server: LiveServer, client: httpx.Client, marker: dict[str, Any]
) -> None:
    with server.agency("readers only", scope=Scope.VEHICLE) as vehicle:
        assert vehicle.get(f"/v1/markers/{marker['id']}/payload.bin").status_code == 403
        assert vehicle.post("/v1/programs", json={"status": "planned"}).status_code == 403


def test_the_agency_key_is_nowhere_in_clear(fresh_server: LiveServer, settings: Settings, place: Place) -> None:
    with fresh_server.client() as admin:
        made = admin.post("/v1/markers", json=cerpm(place())).json()
        assert admin.get(f"/v1/markers/{made['id']}/payload.bin").status_code == 200
    master = settings.resolved_master_key_file
    assert master.stat().st_mode & 0o077 == 0
    database = Database(settings.resolved_database_url)
    with database.read() as connection:
        agency_id = find_first_agency(connection)
        assert agency_id is not None
        key = AgencySecrets(master.read_bytes).find_key(connection, agency_id)
        assert key is not None
        with pytest.raises(Unavailable, match="master key"):
            AgencySecrets(lambda: bytes(32)).find_key(connection, agency_id)
    database.close()
    written = [path.read_bytes() for path in settings.data_dir.rglob("*") if path.is_file() and path != master]
    assert written
    for content in written:
        assert key not in content
        assert master.read_bytes() not in content


def test_only_cerpms_have_a_payload(client: httpx.Client, place: Place) -> None:
    plate = client.post("/v1/markers", json={"position": place()}).json()
    refused = client.get(f"/v1/markers/{plate['id']}/payload.bin")
    assert refused.status_code == 404
    assert "CERPM" in refused.json()["detail"]
    nothing = client.post("/v1/programs", json={"marker_ids": [plate["id"]]})
    assert nothing.status_code == 422


def test_an_unfit_position_is_noted(client: httpx.Client) -> None:
    body = cerpm({"lon_deg": -85.6436, "lat_deg": 42.2531, "crs": "EPSG:4267"})
    made = client.post("/v1/markers", json=body)
    assert made.status_code == 201, made.text
    sent = client.get(f"/v1/markers/{made.json()['id']}/payload.hex")
    assert "not for localization" in sent.headers["waymark-note"]

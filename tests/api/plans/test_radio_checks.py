"""Radio checks over HTTP."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

from app.services.access.access import Scope
from tests.conftest import LiveServer

URL = "/v1/radio-checks"


@pytest.mark.slow
def test_a_fixed_narrow_beacon_is_warned_of_under_the_us_rules(client: httpx.Client) -> None:
    answer = client.post(URL, json={"radio": {"bandwidth_hz": 125_000, "spreading_factor": 7, "interval_s": 2.0}})
    assert answer.status_code == 200, answer.text
    found = answer.json()
    assert found["time_on_air_s"] == pytest.approx(0.061696, abs=1e-6)  # 24 bytes; 20 are 56.576 ms, 27 are 66.816
    bad = [check for check in found["checks"] if check["verdict"] != "ok"]
    assert any("15.247" in check["source"] for check in bad)
    assert found["verdict"] != "ok"
    assert len(found["road"]["station_m"]) == len(found["road"]["markers_in_range"])


def test_more_markers_lose_more_packets(client: httpx.Client) -> None:
    def success(spacing_m: float) -> Any:
        return client.post(URL, json={"road": {"spacing_m": spacing_m}}).json()["packet_success"]

    assert success(6.0) < success(12.0) < success(48.0) <= 1.0


def test_settings_are_recommended(client: httpx.Client) -> None:
    body = {"design_speed_m_s": 13.4, "recommend": True}
    advice = client.post(URL, json=body).json()["recommendation"]
    assert advice["radio"]["bandwidth_hz"] == 500_000  # nothing narrower is lawful for a fixed beacon
    assert advice["sentence"]
    checked = {**body, "radio": advice["radio"], "receiver": {"channels": advice["receiver_channels"]}}
    again = client.post(URL, json={**checked, "recommend": False}).json()
    assert again["read_probability"] == pytest.approx(advice["read_probability"], abs=0.005)


def test_markers_may_be_placed_one_by_one(client: httpx.Client) -> None:
    markers = {"chainage_m": [0.0, 12.0, 30.0], "offset_m": [1.8, -1.8, 1.8]}
    found = client.post(URL, json={"markers": markers}).json()
    assert max(found["road"]["markers_in_range"]) == 3


def test_a_reader_may_check(server: LiveServer) -> None:
    with server.agency("those who look", scope=Scope.VIEWER) as reader:
        assert reader.post(URL, json={}).status_code == 200


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"radio": {"spreading_factor": 13}}, "spreading_factor"),
        ({"radio": {"bandwidth_hz": 1}}, "bandwidth_hz"),
        ({"radio": {"interval_s": 0.001}}, "interval_s"),
        ({"road": {"spacing_m": 0}}, "spacing_m"),
        ({"design_speed_m_s": 1000}, "design_speed_m_s"),
        ({"markers": {"chainage_m": [1.0], "offset_m": [1.0, 2.0]}}, "markers"),
        ({"battery": {"capacity_mah": -1}}, "capacity_mah"),
        ({"receiver": {"channels": 0}}, "channels"),
        ({"min_probability": 1.5}, "min_probability"),
        ({"region": "MOON"}, "region"),
    ],
)
def test_what_cannot_be_is_refused_with_its_field(client: httpx.Client, body: dict[str, Any], field: str) -> None:
    refused = client.post(URL, json=body)
    assert refused.status_code == 422, refused.text
    assert field in refused.json()["field"]
    assert refused.json()["limit"]

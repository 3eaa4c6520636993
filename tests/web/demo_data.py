"""An agency with markers of every family and status, a road, a codebook, vehicles and a decode, for the web pages."""

from __future__ import annotations

from typing import Any

import httpx

from tests.web.operations_data import fill_operations, open_forms

ROAD = "A7"
WAY = [[8.4168, 49.0058], [8.4188, 49.0071], [8.4221, 49.0079]]
STATUSES = ("planned", "built", "surveyed", "active", "active", "suspect")
PLATES = 48
CERPMS = 8


def fill(client: httpx.Client) -> dict[str, str]:
    """Register everything; returns ids by what they are of."""
    road = _made(client, "/v1/roads", {"name": ROAD, "geometry": {"type": "LineString", "coordinates": WAY}})
    answer = client.post("/v1/markers/bulk", json={"items": [{"create": _plate(k)} for k in range(PLATES)]})
    assert answer.status_code == 200, answer.text
    plates = [result["id"] for result in answer.json()["results"]]
    forms = open_forms(client, plates[4:6])
    retired = client.patch(
        f"/v1/markers/{plates[3]}", json={"status": "retired", "reason": "resurfaced"}, headers={"If-Match": '"1"'}
    )
    assert retired.status_code == 200, retired.text
    book = _made(client, "/v1/codebooks", {
        "name": "Town", "design": {"magnets": 3, "length_m": 4, "segment_m": 0.1},
        "meanings": [{"kind": "arrow", "value": "left"}, {"kind": "bend-right", "value": 125}],
    })  # fmt: skip
    entry = book["entries"][1]
    lane = {"geometry": {"type": "LineString", "coordinates": WAY}, "horizontal_rmse_m": 0.02}
    tag = _made(client, "/v1/markers", {
        "family": "magnet", "status": "surveyed", "road": ROAD, "lane": lane,
        "tag": {"code": entry["code"], "codebook_id": book["id"], "chainage_m": 60},
        "site": {"design_speed_m_s": 13.4, "stop_line_chainage_m": 120},
    })  # fmt: skip
    cerpms = [_made(client, "/v1/markers", _cerpm(k)) for k in range(CERPMS)]
    profile = {"camera": {"height_m": 1.4, "horizontal_fov_deg": 70}, "trace": {}}
    vehicle = _made(client, "/v1/vehicles", {"name": "BUS-7", "note": "line 3", "profile": profile})
    lanes = _made(client, "/v1/alignments", {
        "name": "A7, two lanes", "road_id": road["id"],
        "lanes": {"forward": 1, "backward": 1, "width_m": 3.5, "speed_limit_kmh": 70, "centre_style": "dashed"},
    })  # fmt: skip
    plans = [
        _made(client, "/v1/plans", {"name": f"A7, every {spacing} m", "alignment_id": lanes["id"], "rules": {
            "version": 1, "plates": {"spacing_m": spacing}, "decision_points": {},
            "costs": {"currency": "EUR", "items": [{"item": "plate", "per": "plate", "price": 60}]},
        }})
        for spacing in (100, 50)
    ]  # fmt: skip
    return fill_operations(client, forms) | {
        "plate": plates[0], "active": plates[4], "retired": plates[3], "tag": tag["id"], "cerpm": cerpms[0]["id"],
        "road": road["id"], "vehicle": vehicle["id"], "codebook": book["id"],
        "alignment": lanes["id"], "plan": plans[0]["id"], "variant": plans[1]["id"],
    }  # fmt: skip


def _plate(k: int) -> dict[str, Any]:
    share = k / PLATES
    east, north = (WAY[1][0] - WAY[0][0]) * share, (WAY[1][1] - WAY[0][1]) * share
    position: dict[str, Any] = {"lon_deg": WAY[0][0] + east, "lat_deg": WAY[0][1] + north}
    if k % 4:
        position |= {"horizontal_rmse_m": 0.012, "vertical_rmse_m": 0.02, "height_m": 115.2, "survey_method": "RTK",
                     "surveyor": "Crew 2", "crs": "EPSG:9989", "epoch": 2026.5}  # fmt: skip
    body = {"position": position, "code": {"scheme": "id"}, "status": STATUSES[k % len(STATUSES)], "heading_deg": 47.0}
    return body | ({"road": ROAD, "measure_m": round(4.3 * k, 2), "offset_m": 0.0} if k % 8 else {})


def _cerpm(k: int) -> dict[str, Any]:
    share = k / CERPMS
    lon_deg = WAY[1][0] + (WAY[2][0] - WAY[1][0]) * share
    lat_deg = WAY[1][1] + (WAY[2][1] - WAY[1][1]) * share
    return {
        "family": "cerpm", "number": 700 + k, "side": "left" if k % 2 else "right", "status": "active", "road": ROAD,
        "position": {"lon_deg": lon_deg, "lat_deg": lat_deg, "horizontal_rmse_m": 0.02},
        "speed_limit": {"value": 50, "unit": "km/h"},
    }  # fmt: skip


def _made(client: httpx.Client, path: str, body: dict[str, Any]) -> dict[str, Any]:
    answer = client.post(path, json=body)
    assert answer.status_code == 201, answer.text
    return dict(answer.json())

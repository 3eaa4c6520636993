"""Rules with a quality over HTTP: the cheapest plates, the trade-off in the files, and what cannot be."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import httpx
import pytest

from tests.api.plans.test_plans import agency, alignment, client, make_plan
from tests.http import refused

__all__ = ["agency", "alignment", "client"]
pytestmark = pytest.mark.both_databases
NOTHING_ELSE: dict[str, Any] = {"lines": None, "tags": None, "cerpm": None}
QUALITY = {"fix_every_m": 150, "fix_probability": 0.98, "fix_error_m": 0.1}


@pytest.mark.slow
def test_a_required_quality_is_planned_at_the_least_cost(client: httpx.Client, alignment: dict[str, Any]) -> None:
    plan = make_plan(client, alignment, **NOTHING_ELSE, quality=QUALITY)
    assert plan["status"] == "checked"
    assert plan["counts"] == {"plate": 5}
    assert plan["cost"] == 600.0
    found = {finding["name"]: finding for finding in plan["findings"]}
    assert found["fix-probability"]["figure"] >= 0.98
    assert found["predicted-read-rate plates camera day"]["verdict"] == "ok"
    url = f"/v1/plans/{plan['id']}/files"
    table = client.get(f"{url}/trade-off.csv")
    assert table.headers["content-type"].startswith("text/csv")
    assert table.text.splitlines()[1].startswith("150,,600.00,")
    picture = client.get(f"{url}/trade-off.svg")
    assert picture.headers["content-type"].startswith("image/svg+xml")
    assert ElementTree.fromstring(picture.text).tag.endswith("svg")
    plain = make_plan(client, alignment, **NOTHING_ELSE)
    assert client.get(f"/v1/plans/{plain['id']}/files/trade-off.csv").status_code == 404


@pytest.mark.parametrize(
    ("rules", "field"),
    [
        ({"quality": {**QUALITY, "fix_error_m": 0.01}}, "quality"),
        ({"quality": {**QUALITY, "budget": 100}}, "quality.budget"),
        ({"quality": QUALITY, "costs": {}}, "costs.items"),
    ],
)
def test_a_quality_that_cannot_be_is_refused_and_nothing_is_stored(
    client: httpx.Client, alignment: dict[str, Any], rules: dict[str, Any], field: str
) -> None:
    document = {
        "version": 1,
        "plates": {},
        "costs": {"items": [{"item": "plate", "per": "plate", "price": 120}]},
        **rules,
    }
    response = client.post(
        "/v1/plans", json={"name": "impossible", "alignment_id": alignment["id"], "rules": document}, timeout=300
    )
    refused(response, 422, field=field)
    assert client.get("/v1/plans").json()["items"] == []

"""/v1/codebook-drafts over real HTTP: what the codebook that is made then has."""

from __future__ import annotations

import httpx
import pytest

from tests.http import created, refused

pytestmark = pytest.mark.both_databases

URL = "/v1/codebook-drafts"
DESIGN = {"magnets": 3, "length_m": 4.0, "segment_m": 0.1}


@pytest.mark.slow
def test_a_draft_has_the_figures_and_first_codes_of_the_codebook(client: httpx.Client) -> None:
    rules = {"speed_m_s": 20.0, "clearance_m": 0.25, "wrong_way_safe": True}
    response = client.post(URL, json={"design": DESIGN, "rules": rules})
    assert response.status_code == 200, response.text
    draft = response.json()
    meanings = [{"kind": "bend-left", "value": angle} for angle in (10, 20, 30)]
    book = created(client, "/v1/codebooks", name="As drafted", design=DESIGN, rules=rules, meanings=meanings)
    for member in ("design", "rules", "figures"):
        assert draft[member] == book[member]
    assert [entry["code"] for entry in book["entries"]] == [code["code"] for code in draft["codes"][:3]]
    assert len(draft["codes"]) == draft["figures"]["capacity_under_rules"]
    assert draft["codes"][0]["tuple"].startswith("{")


@pytest.mark.parametrize(
    ("body", "field", "words"),
    [
        ({"design": {**DESIGN, "segment_m": 0.3}}, "design.length_m", "whole number of segments"),
        ({"design": {**DESIGN, "magnets": 9}}, "design.magnets", "2 to 7"),
        ({"design": DESIGN, "rules": {"survive_missing": True}}, "rules.survive_missing", "4 magnets or more"),
        ({"design": DESIGN, "rules": {"clearance_m": 3.0}}, "rules.clearance_m", "0.05 to 1 m"),
    ],
)
def test_a_draft_that_cannot_be_is_explained(client: httpx.Client, body: object, field: str, words: str) -> None:
    problem = refused(client.post(URL, json=body), 422)
    assert problem["field"] == field
    assert words in problem["limit"]

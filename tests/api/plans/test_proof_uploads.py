"""What a proof decodes is what a server decodes: a committed and surveyed plan, and uploads of the proof's drives."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import numpy as np
import pytest

from app.families import rows_of_plan
from app.markers.reading import MarkerRow
from app.planning.outputs.plan_document import read_plan
from app.planning.plan import Plan
from app.planning.proof import ProofTerms, UnitKind, drives, plates
from app.planning.proof.prove import Prover
from app.registry.column_types import fetch_all
from app.registry.marker_rows import MARKERS, markers
from app.services.access.access import Scope
from tests.api.plans.test_plans import GEOD, send_road
from tests.conftest import LiveServer
from tests.http import created

pytestmark = pytest.mark.slow

RULES: dict[str, Any] = {
    "version": 1,
    "plates": {"spacing_m": 100},
    "lines": {},
    "tags": {"before": 60.0, "min_before_m": 0},
    "cerpm": {"straight": 2.0, "max_path_error_m": 0.05},
}
TERMS = ProofTerms(drives=1, seed=3, max_sections_per_drive=1, max_markers_per_drive=2)
STATED = ("realization", "epoch", "horizontal_rmse_m", "vertical_rmse_m", "survey_method")
OF_THE_COMMIT = ("id", "created_at", "updated_at", "original", "spec")


def two_lanes() -> bytes:
    """Two lanes of one direction, 3.5 m apart, with a stop line."""
    features: list[dict[str, Any]] = []
    for name, left_m in (("1", 0.0), ("2", 3.5)):
        lon, lat, _ = GEOD.fwd(10.5, 45.5, 0.0, left_m)
        points = [GEOD.fwd(lon, lat, 90.0, at)[:2] for at in range(0, 301, 20)]
        properties = {"lane": name, "width_m": 3.5, "speed_limit_kmh": 50}
        line = {"type": "LineString", "coordinates": points}
        features.append({"type": "Feature", "properties": properties, "geometry": line})
        stop = {"type": "Point", "coordinates": points[-2]}
        features.append({"type": "Feature", "properties": {"kind": "stop_line"}, "geometry": stop})
    return json.dumps({"type": "FeatureCollection", "features": features}).encode()


@pytest.fixture(scope="module")
def client(server: LiveServer) -> Iterator[httpx.Client]:
    """Of an agency with a committed plan."""
    with server.agency("provers", Scope.ADMIN) as author:
        yield author


@pytest.fixture(scope="module")
def plan(server: LiveServer, client: httpx.Client) -> Plan:
    """The committed plan."""
    alignment = send_road(client, two_lanes()).json()
    made = created(client, "/v1/plans", name="proved as uploaded", alignment_id=alignment["id"], rules=RULES)
    url = f"/v1/plans/{made['id']}"
    with server.agency("provers") as other:
        assert other.post(f"{url}/approve", headers={"If-Match": '"1"'}).status_code == 200
    response = client.post(f"{url}/commit", headers={"If-Match": '"2"'})
    assert response.status_code == 201, response.text
    return read_plan(client.get(f"{url}/files/plan.json").content)


@pytest.fixture(scope="module")
def committed(server: LiveServer, client: httpx.Client, plan: Plan) -> dict[int, MarkerRow]:
    """Rows of the registry by numbers of the plan."""
    ids = [marker["id"] for marker in client.get("/v1/markers", params={"limit": 1000}).json()["items"]]
    with server.app.state.use_cases.proofs._database.read() as connection:
        rows = fetch_all(connection, MARKERS.where(markers.c.id.in_(ids)), MarkerRow)
    return {int(row.original["plan"]["number"]): row for row in rows}  # type: ignore[index,call-overload]


class Survey:
    """Notes the rows that a proof is after, and brings the registry to the same state."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.rows: dict[int, MarkerRow] = {}
        original = drives.surveyed_row

        def noted(*arguments: Any) -> MarkerRow:
            row = original(*arguments)
            self.rows[int(row.id)] = row
            return row

        monkeypatch.setattr(drives, "surveyed_row", noted)
        monkeypatch.setattr("app.planning.proof.prove.surveyed_row", noted)

    def store(self, client: httpx.Client, committed: dict[int, MarkerRow]) -> None:
        """Change the registered markers as a crew does after its survey."""
        for number, row in self.rows.items():
            if row.scheme == "line-tag":
                continue  # a line has no single place
            position = {name: getattr(row, name) for name in ("lon_deg", "lat_deg", *STATED)}
            body: dict[str, Any] = {"status": "surveyed", "position": position}
            if row.height_m is not None:
                position["height_m"] = row.height_m
            if row.family == "plate":
                body |= {"heading_deg": row.heading_deg, "heading_rmse_deg": row.heading_rmse_deg}
            url = f"/v1/markers/{committed[number].id}"
            response = client.patch(url, json=body, headers={"If-Match": "*"})
            assert response.status_code == 200, response.text


def decode(client: httpx.Client, content: bytes, name: str, context: dict[str, Any]) -> dict[str, Any]:
    parts = {"file": (name, content), "context": ("context", json.dumps(context).encode(), "application/json")}
    response = client.post("/v1/decodes", files=parts, timeout=120)
    assert response.status_code == 201, response.text
    result: dict[str, Any] = response.json()
    return result


def prover_of(plan: Plan) -> Prover:
    return Prover(plan, TERMS, rows_of_plan(plan, drives.START))


def noting(monkeypatch: pytest.MonkeyPatch, module: Any, name: str) -> list[tuple[Any, Any]]:
    """Arguments and results of the calls of a function."""
    calls: list[tuple[Any, Any]] = []
    original: Callable[..., Any] = getattr(module, name)

    def noted(*arguments: Any, **named: Any) -> Any:
        result = original(*arguments, **named)
        calls.append((arguments, result))
        return result

    monkeypatch.setattr(module, name, noted)
    return calls


def test_the_rows_of_a_proof_are_those_of_a_commit(plan: Plan, committed: dict[int, MarkerRow]) -> None:
    assert {row.family for row in committed.values()} == {"plate", "magnet", "cerpm"}
    rows = rows_of_plan(plan, drives.START)
    assert rows.keys() == committed.keys()
    for number, row in rows.items():
        stored = committed[number]
        for name in MarkerRow._fields:
            if name not in OF_THE_COMMIT:
                assert getattr(row, name) == getattr(stored, name), (number, name)
        if row.spec is not None:
            chosen = {"codebook_id": None} if "codebook_id" in stored.spec else {}
            if row.family == "cerpm":  # the line of a committed plan, which has an id
                assert stored.original is not None
                plan_id = stored.original["plan"]["id"]
                chosen = {"line": stored.spec["line"].removeprefix(f"{plan_id} ")}
                assert stored.spec["line"] != chosen["line"]
            assert json.loads(json.dumps(row.spec)) == {**stored.spec, **chosen}


def test_a_server_estimates_the_path_of_the_proof(
    client: httpx.Client, plan: Plan, committed: dict[int, MarkerRow], monkeypatch: pytest.MonkeyPatch
) -> None:
    marker_ids = [row.id for row in committed.values() if row.family == "cerpm"]
    wanted = {"marker_ids": marker_ids, "with_keys": True}
    programs = csv.DictReader(io.StringIO(client.post("/v1/programs", json=wanted).text))
    keys = {int(program["number"]): bytes.fromhex(program["key_hex"]) for program in programs}
    survey = Survey(monkeypatch)
    monkeypatch.setattr(drives, "_key_of", keys.__getitem__)
    monkeypatch.setattr("app.decoding.recordings.derive_marker_key", lambda _agency_key, number: keys[number])
    packs, paths = noting(monkeypatch, drives, "pack"), noting(monkeypatch, drives, "estimate_path")
    prover = prover_of(plan)
    unit = next(unit for unit in prover.list_units() if unit.kind is UnitKind.LANE)
    prover.prove_unit(unit)
    ((_files, upload),), ((_given, path),) = packs, paths
    assert path.refusal is None
    survey.store(client, committed)
    surveyed = client.get(f"/v1/markers/{marker_ids[0]}").json()
    assert surveyed["line"] in {row.spec["line"] for row in committed.values() if row.family == "cerpm"}
    monkeypatch.undo()
    decoded = decode(client, upload.read(), "drive.zip", {"packets": {}})
    lane = decoded["lane"]
    assert lane["refusal"] is None
    assert lane["stations"]["lon_deg"] == pytest.approx(path.lon_deg.tolist(), abs=2e-9)
    assert lane["stations"]["lat_deg"] == pytest.approx(path.lat_deg.tolist(), abs=2e-9)
    left_out = sorted(marker["number"] for marker in decoded["markers"] if marker["left_out"])
    assert left_out == sorted(out.number for out in path.left_out)
    assert len(left_out) > 10, "those of the other lane"


def test_a_server_locates_the_vehicle_of_the_proof_at_plates(
    client: httpx.Client, plan: Plan, committed: dict[int, MarkerRow], monkeypatch: pytest.MonkeyPatch
) -> None:
    survey = Survey(monkeypatch)
    loads, fixes = noting(monkeypatch, plates, "load_image"), noting(monkeypatch, plates, "fuse_fixes")
    contexts: list[dict[str, Any]] = []
    original = plates.PlatePass.context

    def noted(one: plates.PlatePass, ahead_m: float) -> Any:
        context = original(one, ahead_m)
        contexts.append(context.document())
        return context

    monkeypatch.setattr(plates.PlatePass, "context", noted)
    prover = prover_of(plan)
    prover.prove_unit(next(unit for unit in prover.list_units() if unit.kind is UnitKind.PLATES))
    survey.store(client, committed)
    monkeypatch.undo()
    compared = 0
    for ((data,), _frame), (_of, fix), context in zip(loads, fixes, contexts, strict=True):
        (frame,) = decode(client, data, "frame.jpg", context)["frames"]
        if fix is None:
            assert frame["fix"] is None
            continue
        compared += 1
        assert frame["fix"]["lon_deg"] == pytest.approx(fix.vehicle.lon_deg, abs=2e-9)
        assert frame["fix"]["lat_deg"] == pytest.approx(fix.vehicle.lat_deg, abs=2e-9)
        assert np.isfinite(frame["fix"]["heading_deg"])
    assert compared >= 2


def test_a_server_reads_the_tag_of_the_proof(
    client: httpx.Client, plan: Plan, committed: dict[int, MarkerRow], monkeypatch: pytest.MonkeyPatch
) -> None:
    survey = Survey(monkeypatch)
    tables, traces = noting(monkeypatch, drives, "write_tables"), noting(monkeypatch, drives, "decode_upload")
    prover = prover_of(plan)
    prover.prove_unit(next(unit for unit in prover.list_units() if unit.kind is UnitKind.TAGS))
    survey.store(client, committed)
    monkeypatch.undo()
    for (_trace, files), ((one, _simulated), trace) in zip(tables, traces, strict=True):
        context = {
            "coarse_position": one.position.model_dump(mode="json"), "captured_at": drives.START.isoformat(),
            "trace": {"unit": "uT", "axes": "ISO8855", "bar": {"forward_m": drives.FORWARD_M}},
        }  # fmt: skip
        result = decode(client, drives.pack(files).read(), "drive.zip", context)
        assert [tag["tag"] for tag in result["tags"]] == [tag.reading.tag.text for tag in trace.tags]
        for found, tag in zip(result["tags"], trace.tags, strict=True):
            assert (found["fix"] is None) == (tag.fix is None)
            if tag.fix is not None:
                assert found["fix"]["lon_deg"] == pytest.approx(tag.fix.lon_deg, abs=2e-9)
                assert found["fix"]["lat_deg"] == pytest.approx(tag.fix.lat_deg, abs=2e-9)
        assert len(result["magnets"]) == len(trace.magnets)

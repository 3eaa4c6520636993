"""What a proof passes to the decoders: files of the drive, declarations, and rows of registered markers."""

from __future__ import annotations

import ast
import inspect
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import app.planning.proof
from app.decoding import recordings
from app.decoding.declarations import DeclaredPackets, DeclaredTrace, DecodeContext
from app.formats.alignments.geometry import EventKind
from app.lanes import estimate
from app.markers.reading import MarkerRow
from app.planning.alignment import RoadEvent
from app.planning.plan import Plan, PlannedCerpm
from app.planning.proof import ProofTerms, UnitKind, drives, plates
from app.planning.proof.prove import Prover
from tests.planning.proof.conftest import plan_on, prover_of
from tests.planning.roads import bend, straight

pytestmark = pytest.mark.slow


def lane_unit(prover: Prover) -> Any:
    return next(unit for unit in prover.list_units() if unit.kind is UnitKind.LANE)


def spied(monkeypatch: pytest.MonkeyPatch, module: Any, name: str) -> list[dict[str, Any]]:
    """Arguments of the calls of a function, by name, and its results under `result`."""
    calls: list[dict[str, Any]] = []
    original = getattr(module, name)

    def spy(*arguments: Any, **named: Any) -> Any:
        bound = inspect.signature(original).bind(*arguments, **named).arguments
        result = original(*arguments, **named)
        calls.append({**bound, "result": result})
        return result

    monkeypatch.setattr(module, name, spy)
    return calls


def test_a_proof_calls_no_decoder_by_itself() -> None:
    """Functions of decoders and of lanes are called by `app.decoding` only; types may be named."""
    for path in Path(app.planning.proof.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                assert not any(alias.name.startswith(("app.decoders", "app.lanes")) for alias in node.names), path
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith(("app.decoders", "app.lanes")):
                for alias in node.names:
                    assert inspect.isclass(getattr(import_module(str(node.module)), alias.name)), (path, alias.name)


def test_a_path_is_estimated_from_the_uploaded_files_and_the_registered_rows(
    cerpms: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    prover = prover_of(cerpms, ProofTerms(drives=1, seed=2))
    read = spied(monkeypatch, drives, "read_drive_files")
    matched = spied(monkeypatch, drives, "read_packets_of")
    estimated = spied(monkeypatch, drives, "estimate_path")
    surveyed = spied(monkeypatch, drives, "surveyed_row")
    fitted = spied(monkeypatch, estimate, "fit_lane")
    drives.drive_cerpms(prover.lane_pass(lane_unit(prover)))
    ((files,), (packets,), (path,), (fit,)) = read, matched, estimated, fitted
    assert files.keys() - {"result"} == {"name", "file", "declared"}
    assert files["declared"] == packets["declared"] == path["declared"] == DeclaredPackets()
    assert packets.keys() - {"result"} == {"files", "known", "declared", "received_at", "observed_at"}
    assert packets["files"] is files["result"]
    assert path.keys() - {"result"} == {"markers", "track", "declared", "strengths"}
    assert path["track"] is fit["track"] is files["result"].track
    assert (fit["method"], fit["rules"]) == ("waymark", recordings.LaneRules())
    rows = {int(one["result"].digits): one["result"] for one in surveyed}
    assert packets["known"].rows == {number: rows[number] for number in files["result"].numbers}
    assert packets["known"].earlier_spans == {}
    markers = fit["markers"]
    assert len(markers) > 20
    for number, lon, lat, side in zip(markers.number, markers.lon_deg, markers.lat_deg, markers.side, strict=True):
        assert (lon, lat) == pytest.approx((rows[number].lon_deg, rows[number].lat_deg), abs=1e-9)
        assert side == recordings.side_of(rows[number])
    lines = {(line, recordings.line_of(rows[n])) for n, line in zip(markers.number, markers.line, strict=True)}
    assert len(lines) == len({line for line, _ in lines}) == len({name for _, name in lines}) == 3
    assert {name for _, name in lines} == {("road", "1 left"), ("road", "1 right"), ("road", "2 right")}


@pytest.mark.parametrize("name", ["1", "2"])
def test_the_markers_of_the_other_lane_reach_the_fit(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    lane = straight(400, speed_kmh=50.0)
    beside_lon, beside_lat = lane.position_at(lane.chainage_m, 3.5)
    beside = replace(lane, name="2", lon_deg=beside_lon, lat_deg=beside_lat)
    plan = plan_on(lane, beside, cerpm={})
    prover = prover_of(plan, ProofTerms(drives=1, seed=4))
    one = prover.lane_pass(next(unit for unit in prover.list_units() if unit.lane == name))
    fitted = spied(monkeypatch, estimate, "fit_lane")
    path = drives.drive_cerpms(one)
    details = [marker.detail for marker in plan.markers if isinstance(marker.detail, PlannedCerpm)]
    all_numbers = {detail.number for detail in details}
    assert all_numbers - one.own, "a row of the other lane alone"
    assert set(fitted[0]["markers"].number.tolist()) == all_numbers
    assert path["refusal"] is None
    assert path["covered"] == path["places"] > 0
    assert path["square_sum_m2"] / path["covered"] < 0.05**2


def test_what_is_known_of_the_driven_lane_only_judges_the_path(cerpms: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    prover = prover_of(cerpms, ProofTerms(drives=1, seed=5))
    estimated = spied(monkeypatch, drives, "estimate_path")
    unit = lane_unit(prover)
    judged = drives.drive_cerpms(prover.lane_pass(unit))
    unjudged = drives.drive_cerpms(replace(prover.lane_pass(unit), own=frozenset()))
    first, second = (call["result"] for call in estimated)
    assert np.array_equal(first.lon_deg, second.lon_deg)
    assert np.array_equal(first.lat_deg, second.lat_deg)
    assert judged["markers"] > unjudged["markers"] == 0


def test_frames_are_searched_and_matched_with_rows_within_reach_of_the_coarse_position(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = plan_on(straight(600, speed_kmh=50.0), plates={"spacing_m": 50})
    prover = prover_of(plan, ProofTerms(drives=1, max_markers_per_drive=1))
    loaded, searched = spied(monkeypatch, plates, "load_image"), spied(monkeypatch, plates, "search_plates")
    found, fixed = spied(monkeypatch, plates, "read_plates"), spied(monkeypatch, plates, "fix_from_match")
    contexts = spied(monkeypatch, plates.PlatePass, "context")
    (unit,) = prover.list_units()
    prover.prove_unit(unit)
    assert fixed
    for file, search, read, context in zip(loaded, searched, found, contexts, strict=True):
        assert file.keys() - {"result"} == {"data"}
        assert read.keys() - {"result"} == {"pixels", "search"}
        assert read["pixels"] is file["result"].pixels
        assert read["search"] is search["result"]
        sent = DecodeContext.model_validate(context["result"].document())
        assert search["camera"] == sent.camera_of(file["result"].header)
        rows = search["nearby"].rows
        assert 1 < len(rows) < len(plan.markers), "those within reach, not only the one that is passed"
        assert all(isinstance(row, MarkerRow) and row.status == "surveyed" for row in rows)
    for fix in fixed:
        assert fix["vehicle_heading_deg"] == contexts[0]["result"].heading_deg


def test_recordings_are_decoded_with_all_registered_tags_within_reach(monkeypatch: pytest.MonkeyPatch) -> None:
    stops = tuple(RoadEvent(EventKind.SPEED_LIMIT, "1", at, value) for at, value in ((160.0, 40.0), (900.0, 60.0)))
    plan = plan_on(bend(300.0, 800, 20.0, speed_kmh=40.0), events=stops, tags={}, lines={})
    prover = prover_of(plan, ProofTerms(drives=1))
    read, found = spied(monkeypatch, drives, "read_trace"), spied(monkeypatch, drives, "find_magnets")
    tags = [number for number, row in prover.rows.items() if row.scheme == "information-tag"]
    assert len(tags) == 2
    assert drives.read_tag(prover.tag_pass(prover.by_number[tags[0]], 0))[0]
    ((file,), (trace,)) = read, found
    assert file.keys() - {"result"} == {"parts", "declaration"}
    assert file["result"].report.formats.keys() == {"field.csv", "speed.csv", "heading.csv"}
    assert trace["trace"] is file["result"].trace
    assert trace["declared"] == DeclaredTrace.model_validate(
        {"unit": "uT", "axes": "ISO8855", "bar": {"forward_m": drives.FORWARD_M}}
    )
    assert set(trace["tags"]) == {prover.rows[number].digits for number in tags}, "700 m ahead too"
    assert trace["formats"] == ()

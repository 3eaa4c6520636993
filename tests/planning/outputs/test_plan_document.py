"""Plans as documents, and back."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import orjson
import pytest

from app.errors import UnreadableUpload
from app.formats.alignments.geometry import StationEquation, Stationing
from app.markers.reading import Verdict
from app.planning.alignment import Alignment, Lane
from app.planning.outputs.plan_document import read_plan, write_plan
from app.planning.plan import Plan, PlanFinding
from app.radio.settings import RadioSettings
from tests.planning.outputs.made import full_plan


def assert_equal(a: object, b: object) -> None:
    """Field by field, with NaN equal to NaN."""
    assert type(a) is type(b)
    if isinstance(a, Plan | Alignment | Lane):
        for field in fields(a):
            assert_equal(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, tuple):
        assert isinstance(b, tuple)
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            assert_equal(one, other)
    elif isinstance(a, np.ndarray):
        assert isinstance(b, np.ndarray)
        assert a.dtype == b.dtype
        assert np.array_equal(a, b, equal_nan=True)
    elif hasattr(a, "ring_deg"):
        assert np.array_equal(a.ring_deg, b.ring_deg)  # type: ignore[attr-defined]
        assert a.kind == b.kind  # type: ignore[attr-defined]
    else:
        assert a == b


def changed_plan() -> Plan:
    """With findings, a station equation, and heights that are unknown here and there."""
    plan = full_plan()
    first, second = plan.alignment.lanes
    first = replace(first, height_m=np.where(first.chainage_m > 100, np.nan, first.height_m))
    second = replace(second, height_m=np.full_like(second.height_m, np.nan))
    road = replace(
        plan.alignment,
        lanes=(first, second),
        stationing={first.road: Stationing(1000.0, (StationEquation(100.0, 1100.0, 200.0),))},
        realization="ITRF2014",
        epoch=2010.5,
        warnings=("a warning",),
    )
    finding = PlanFinding("magnet-spacing", 6.0, "<=", 6.0, "m", "METRO 6.3", Verdict.OK, "fine", "1", 3.5, 8.4, 49.0)
    return replace(plan, alignment=road, findings=(finding,), radio=RadioSettings(spreading_factor=8))


def test_a_plan_comes_back_as_it_was() -> None:
    plan = changed_plan()
    assert {marker.family for marker in plan.markers} == {"plate", "magnet", "cerpm"}
    assert plan.left_out
    assert plan.codebook is not None
    again = read_plan(write_plan(plan))
    assert_equal(plan, again)
    assert write_plan(again) == write_plan(plan)


def test_a_plan_of_an_earlier_release_is_read() -> None:
    plan = full_plan()
    written = write_plan(plan)
    older = written.replace(b'_m_s2"', b'_mps2"').replace(b'speed_m_s"', b'speed_mps"')
    assert older != written
    assert write_plan(read_plan(older)) == written


def test_stations_of_the_first_format_were_true_distances() -> None:
    document = orjson.loads(write_plan(full_plan()))
    document["format"] = "waymark-plan/1"
    del document["alignment"]["stationing"]
    equation = {"distance_m": 100.0, "back_m": 5100.0, "ahead_m": 200.0}
    document["alignment"] |= {"start_station_m": 5000.0, "station_equations": [equation]}
    read = read_plan(orjson.dumps(document))
    for marker, written in zip(read.markers, document["markers"], strict=True):
        at_m = written["station_m"]
        assert marker.station_m == pytest.approx(5000.0 + at_m if at_m < 100 else 100.0 + at_m)
        lane = read.alignment.lane(marker.lane)
        assert read.alignment.stations_at(lane, marker.chainage_m) == pytest.approx([marker.station_m], abs=1e-6)
    assert_equal(read_plan(write_plan(read)), read)


def test_the_document_is_plain_json_with_a_summary() -> None:
    document = orjson.loads(write_plan(full_plan()))
    assert document["format"] == "waymark-plan/2"
    assert document["counts"] == full_plan().counts
    lane = document["alignment"]["lanes"][0]
    assert lane["length_m"] == pytest.approx(full_plan().alignment.lanes[0].length_m)
    assert lane["arrays"]["width_m"] == 3.5, "equal values are one number"
    assert len(lane["arrays"]["lon_deg"]) == lane["samples"]


def damaged(path: list[str | int], value: Any) -> bytes:
    document = orjson.loads(write_plan(full_plan()))
    here = document
    for part in path[:-1]:
        here = here[part]
    here[path[-1]] = value
    return orjson.dumps(document)


@pytest.mark.parametrize(
    ("data", "place"),
    [
        (b"", "plan"),
        (b"[]", "plan"),
        (damaged(["format"], "waymark-plan/9"), "format"),
        (damaged(["rules", "plates", "spacing_m"], -1), "rules.plates.spacing_m"),
        (damaged(["alignment", "lanes", 0, "arrays", "lon_deg"], [1.0, 2.0]), "alignment.lanes.0"),
        (damaged(["alignment", "lanes", 0, "arrays", "lat_deg"], [{}]), "alignment.lanes.0.arrays.lat_deg"),
        (damaged(["alignment", "lanes", 0, "arrays"], {}), "alignment.lanes.0"),
        (damaged(["markers", 0, "lon_deg"], "x"), "markers.0.lon_deg"),
        (damaged(["codebook", "entries"], 3), "codebook"),
    ],
)
def test_a_damaged_document_names_the_place(data: bytes, place: str) -> None:
    with pytest.raises(UnreadableUpload) as raised:
        read_plan(data)
    assert raised.value.field is not None
    assert raised.value.field.startswith(place)
    assert raised.value.cure

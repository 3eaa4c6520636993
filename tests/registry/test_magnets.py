"""Where magnets lie, and what migration 0002 does to a registry that has some."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import pytest
import sqlalchemy as sa

from app.encoders.magnet import CodebookRules
from app.errors import StaleVersion
from app.families.documents import PositionIn
from app.families.magnet.layouts import LaneIn, LineStringIn, MagnetIn, TagIn
from app.families.plate.plates import PlateIn
from app.markers.magnet_design import Meaning, MeaningKind, TagDesign
from app.registry import agencies, markers
from app.registry.database import Database
from app.registry.markers import MarkerFilter, list_magnets_in, list_markers
from app.registry.spatial import Box, box_around
from app.services.access.access import Caller, Scope
from app.services.markers.codebooks import Codebooks
from app.services.markers.markers import MarkerChange, Markers

NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


@pytest.fixture
def caller(database: Database) -> Caller:
    with database.write() as connection:
        return Caller(agencies.add_agency(connection, "one", NOW), "key", "tester", Scope.PLANNER)


def _register(database: Database, caller: Caller, lon_deg: float = 7.0) -> dict[str, Any]:
    end_deg = (lon_deg + 0.001 + 180.0) % 360.0 - 180.0
    return Markers(database, lambda: NOW).register(caller, _tag(lon_deg, end_deg))[0]


def _tag(start_deg: float, end_deg: float, offset_m: float = 0.0) -> MagnetIn:
    line = LineStringIn(type="LineString", coordinates=[[start_deg, 1.0], [end_deg, 1.0]])
    tag = TagIn(code="SNS_4_0.1_10-30", chainage_m=10.0, offset_m=offset_m)
    return MagnetIn(family="magnet", lane=LaneIn(geometry=line), tag=tag)


def _numbers(database: Database, box: Box, **filtered: Any) -> list[int]:
    with database.read() as connection:
        return sorted(row.number for row in list_magnets_in(connection, box, **filtered))


def test_every_magnet_is_found_where_it_lies(database: Database, caller: Caller) -> None:
    marker = _register(database, caller)
    for magnet in marker["magnets"]:
        assert _numbers(database, box_around(magnet["lon_deg"], magnet["lat_deg"], 0.3)) == [magnet["number"]]
    around = box_around(marker["position"]["lon_deg"], marker["position"]["lat_deg"], 20.0)
    assert _numbers(database, around) == [1, 2, 3]
    assert _numbers(database, around, ignoring=marker["id"]) == []
    Markers(database, lambda: NOW).change(caller, marker["id"], MarkerChange({"status": "retired"}), 1)
    assert _numbers(database, around) == []


def test_magnets_over_the_antimeridian(database: Database, caller: Caller) -> None:
    marker = _register(database, caller, lon_deg=179.99989)
    assert _signs(marker) == [1, 1, -1]
    assert _numbers(database, Box(179.9, 0.9, -179.9, 1.1)) == [1, 2, 3]
    beside = _tag(179.99989, -179.99911, offset_m=1.0)
    checks = Markers(database, lambda: NOW).register(caller, beside)[0]["checks"]
    assert next(c for c in checks if c.name == "neighbour-tag").figure == pytest.approx(1.0, abs=1e-3)


def _signs(marker: dict[str, Any]) -> list[int]:
    return [1 if magnet["lon_deg"] > 0 else -1 for magnet in marker["magnets"]]


def test_migration_0002_down_and_up_keeps_plates(database: Database, caller: Caller) -> None:
    plate = PlateIn(position=PositionIn(lon_deg=7.0, lat_deg=1.0))
    plate_id = Markers(database, lambda: NOW).register(caller, plate)[0]["id"]
    _register(database, caller)
    Codebooks(database, lambda: NOW).make(
        caller, "b", TagDesign(3, 4.0, 0.1), CodebookRules(), [Meaning(MeaningKind.ARROW, "left")]
    )
    database.migrate("0001")
    with database.read() as connection:
        names = set(sa.inspect(connection).get_table_names())
        assert not {name for name in names if "magnet" in name or "codebook" in name}
        assert connection.exec_driver_sql("SELECT id FROM markers").scalars().all() == [plate_id]
        assert connection.exec_driver_sql("SELECT marker_id FROM marker_versions").scalars().all() == [plate_id]
        if database.path is not None:
            assert connection.exec_driver_sql("SELECT count(*) FROM markers_rtree").scalar() == 1
            assert connection.exec_driver_sql("PRAGMA foreign_key_check").all() == []
    database.migrate()
    with database.read() as connection:
        (row,) = list_markers(connection, caller.agency_id, MarkerFilter(), after=None, limit=10)
    assert (row.id, row.spec) == (plate_id, None)
    _register(database, caller)


def test_a_codebook_is_replaced_at_its_version_only(database: Database, caller: Caller) -> None:
    made, _ = Codebooks(database, lambda: NOW).make(caller, "b", TagDesign(3, 4.0, 0.1), CodebookRules())
    with database.write() as connection:
        change = {"version": 1, "now": NOW}
        assert (
            markers.CODEBOOKS.update(connection, caller.agency_id, made["id"], {"entries": []}, **change).version == 2
        )
        with pytest.raises(StaleVersion):
            markers.CODEBOOKS.update(connection, caller.agency_id, made["id"], {"entries": []}, **change)
        with pytest.raises(StaleVersion):
            markers.CODEBOOKS.update(connection, "another agency", made["id"], {"entries": []}, version=2, now=NOW)

"""Roads in the store: the migration down and up on data, many markers measured again, and the log that covers them."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest
import sqlalchemy as sa
from pyproj import Geod

from app.families.cerpm import CerpmIn
from app.families.documents import PositionIn
from app.registry.audit import audit_log
from app.registry.database import Database
from app.registry.marker_rows import marker_versions, markers
from app.services.access.access import Access, Caller, Scope
from app.services.markers.markers import Markers
from app.services.roads.documents import GeoLineIn, RoadIn, RoadPatch, StationIn
from app.services.roads.roads import Roads

GEOD = Geod(ellps="WGS84")
NOW = datetime(2026, 3, 4, tzinfo=UTC)
COUNT = 1_500
LINE = ((8.4, 49.0), GEOD.fwd(8.4, 49.0, 60, 10_000)[:2])
ROAD = RoadIn(name="A 5", geometry=GeoLineIn(type="LineString", coordinates=[list(point) for point in LINE]))


@pytest.fixture
def caller(database: Database) -> Caller:
    access = Access(database, lambda: NOW)
    return access.authenticate(access.create_key("roads", Scope.ADMIN, label="test"))


def _fill(database: Database, caller: Caller) -> np.ndarray:
    """One registered marker, and copies of its row along the road; their distances from its start. [m]"""
    place = PositionIn(lon_deg=-30.0, lat_deg=-30.0)
    Markers(database, lambda: NOW).register(caller, CerpmIn(family="cerpm", position=place, road="A 5"))
    along = np.linspace(1.0, 9_999.0, COUNT)
    same = np.ones(COUNT)
    lon, lat, _ = GEOD.fwd(LINE[0][0] * same, LINE[0][1] * same, 60 * same, along)
    with database.write() as connection:
        template = dict(connection.execute(sa.select(markers)).mappings().one())
        connection.execute(
            sa.insert(markers),
            [
                {**template, "row": k + 10, "id": f"019cb624-0000-7000-8000-{k:012x}", "digits": str(k + 10)}
                | {"lon_deg": float(lon[k]), "lat_deg": float(lat[k])}
                for k in range(COUNT)
            ],
        )
    return along


def _measures(database: Database) -> list[tuple[float, float, int]]:
    query = sa.select(markers.c.measure_m, markers.c.offset_m, markers.c.version).where(markers.c.lat_deg > 0)
    with database.read() as connection:
        return [(row[0], row[1], row[2]) for row in connection.execute(query.order_by(markers.c.id))]


def test_thousands_of_markers_are_measured_and_the_log_covers_each(database: Database, caller: Caller) -> None:
    along = _fill(database, caller)
    roads = Roads(database, lambda: NOW)
    road, _ = roads.register(caller, ROAD)
    assert (road["markers"]["measured"], road["markers"]["left"]) == (COUNT, 1)
    found = _measures(database)
    assert np.allclose([measure for measure, _, _ in found], along, atol=1e-6)
    assert np.abs([offset for _, offset, _ in found]).max() < 1e-6
    assert {version for _, _, version in found} == {2}
    calibration = [StationIn(measure_m=1_000.0, vertex=0), StationIn(measure_m=10_900.0, vertex=1)]
    changed = roads.change(caller, road["id"], RoadPatch(calibration=calibration), 1)
    assert changed["markers"]["measured"] == COUNT
    assert np.allclose([measure for measure, _, _ in _measures(database)], 1_000 + along * 0.99, atol=1e-6)
    with database.read() as connection:
        entries = connection.execute(sa.select(audit_log).order_by(audit_log.c.number)).mappings().all()
        newest = connection.execute(
            sa.select(marker_versions.c.marker)
            .where(marker_versions.c.version == 3)
            .order_by(marker_versions.c.marker_id)
        ).scalars()
        said = [(marker["measure_m"], marker["offset_m"], marker["version"]) for marker in newest]
    assert [entry["versions"] for entry in entries if entry["action"] == "road.measured"] == [COUNT, COUNT]
    assert said == _measures(database)


@pytest.mark.slow
def test_down_and_up_again_keeps_markers_and_their_measures(database: Database, caller: Caller) -> None:
    _fill(database, caller)
    Roads(database, lambda: NOW).register(caller, ROAD)
    before = _measures(database)
    database.migrate("0006")
    with database.read() as connection:
        inspector = sa.inspect(connection)
        assert not {"roads", "road_versions"} & set(inspector.get_table_names())
        assert "ix_markers_agency_id_road_measure_m_id" not in {i["name"] for i in inspector.get_indexes("markers")}
    database.migrate()
    assert database.is_ready()
    assert _measures(database) == before
    road, _ = Roads(database, lambda: NOW).register(caller, ROAD)
    assert (road["version"], road["markers"]["unchanged"]) == (1, COUNT)

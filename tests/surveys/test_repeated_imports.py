"""Imports of surveys: once more, in a local grid, and the report on what was not declared."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import sqlalchemy as sa
from pyproj import Transformer

from app.errors import InvalidParameter
from app.families.surveys import MarkerRules
from app.formats.format import SpooledFile
from app.registry.database import Database
from app.registry.engines import seeing_every_agency
from app.registry.marker_rows import markers
from app.services.access.access import Access, Scope
from app.services.decoder_tasks import SameProcess
from app.services.ports import utc_now
from app.services.surveys.import_report import DeclarationIn, ImportReport, import_input
from app.services.surveys.imports import SETTLED, Imports

DECLARED = {"crs": "EPSG:25832", "family": "cerpm", "area_deg": [8.3, 48.9, 8.6, 49.1], "ignore_heights": True}
EAST, NORTH = 457000.0, 5428000.0
Send = Callable[..., ImportReport]


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Database]:
    """A registry that the tests of this module share, each with an agency of its own."""
    opened = Database(f"sqlite:///{tmp_path_factory.mktemp('registry') / 'registry.sqlite3'}")
    opened.open()
    opened.migrate()
    yield opened
    opened.close()


@pytest.fixture
def send(database: Database, request: pytest.FixtureRequest) -> Send:
    """Imports a file with a declaration as the API takes it."""
    access = Access(database, utc_now)
    caller = access.authenticate(access.create_key(request.node.name, Scope.PLANNER, "surveys"))
    imports = Imports(database, utc_now, SameProcess(), MarkerRules())

    def run(data: bytes, step: Callable[[float], None] = lambda _progress: None, **declared: Any) -> ImportReport:
        declaration = DeclarationIn.model_validate({**DECLARED, **declared})
        return imports.run(caller, import_input(declaration, SpooledFile.of(data)), step=step)[0]

    return run


def _csv(*, moved_m: float = 0.0, prefix: str = "A") -> bytes:
    rows = [f"{prefix}{k},{EAST + 10 * k + moved_m:.3f},{NORTH:.3f}" for k in range(8)]
    return "\n".join(["point,easting,northing", *rows]).encode()


def test_the_same_file_is_refused_and_a_comparison_is_proposed(send: Send) -> None:
    assert send(_csv())["stored"] == 8
    report = send(_csv())
    assert (report["outcome"], report["stored"]) == ("refused", 0)
    fault = report["faults"][0]
    assert (fault["row"], fault["code"]) == (None, "file_already_imported")
    assert "8 registered markers come from it" in fault["message"]
    assert "compare" in str(fault["proposal"])
    assert "duplicates" in str(fault["proposal"])


def test_the_same_points_in_another_file_are_refused_row_by_row(send: Send) -> None:
    assert send(_csv())["stored"] == 8
    again = _csv(moved_m=0.04) + b"\nB1,457200.000,5428000.000\n"
    report = send(again)
    assert (report["outcome"], report["counts"]["already_registered"]) == ("refused", 8)
    assert "is registered from point A0, 0.04 m from this row" in report["faults"][0]["message"]
    assert send(again, mode="good")["stored"] == 1


def test_a_point_number_or_a_poor_accuracy_widen_what_is_the_same_point(send: Send) -> None:
    assert send(_csv())["stored"] == 8
    assert send(_csv(moved_m=0.3), dry_run=True)["counts"]["already_registered"] == 8
    renamed = send(_csv(moved_m=0.3, prefix="B"), dry_run=True)["counts"]
    assert "already_registered" not in renamed
    assert renamed["marker_already_there"] == 8
    poor = send(_csv(moved_m=0.3, prefix="B"), dry_run=True, survey={"horizontal_rmse_m": 0.2})
    assert poor["counts"]["already_registered"] == 8


def test_a_marker_of_another_family_may_stand_at_the_same_place(send: Send) -> None:
    assert send(_csv())["stored"] == 8
    assert send(_csv(prefix="B"), dry_run=True)["counts"]["already_registered"] == 8
    assert "already_registered" not in send(_csv(prefix="B"), dry_run=True, family="plate")["counts"]


def test_duplicates_can_be_declared(send: Send) -> None:
    assert send(_csv())["stored"] == 8
    report = send(_csv(), duplicates="store")
    assert (report["stored"], report["counts"]["marker_already_there"]) == (8, 8)


def test_the_same_file_may_be_compared(send: Send) -> None:
    assert send(_csv())["stored"] == 8
    report = send(_csv(), compare=True, match="nearest", dry_run=True)
    assert report["comparison"] is not None
    assert report["comparison"]["matched"] == 8
    assert not {"file_already_imported", "already_registered"} & report["counts"].keys()


def test_the_report_states_everything_that_was_not_declared(send: Send) -> None:
    rows = "\n".join(f"{k};{EAST + 10 * k:.3f};{NORTH:.3f};EOP".replace(".", ",") for k in range(8))
    text = f"# Büro Müller\nAuftrag 7\nPunkt;Rechtswert;Hochwert;Code\n{rows}\n".encode("cp1252")
    report = send(text, dry_run=True)
    assert report["good_rows"] == 8
    assert {one.what: one.value for one in report["detected"]} == {
        "format": "csv", "encoding": "cp1252", "delimiter": ";", "first row": "line 4", "comments": "1 lines left out",
        "column of point": "Punkt", "column of easting": "Rechtswert", "column of northing": "Hochwert",
        "decimal sign": ",", "columns without a role": "Code",
    }  # fmt: skip
    assert all(one.evidence for one in report["detected"])
    assert report["counts"]["role_without_evidence"] == 1
    columns = {"point": "Punkt", "easting": "Rechtswert", "northing": "Hochwert", "code": None}
    declared = {"format": "csv", "encoding": "windows-1252", "delimiter": ";", "decimal": ",", "columns": columns}
    report = send(text, dry_run=True, **declared)
    assert {one.what for one in report["detected"]} == {"first row", "comments", "columns without a role"}
    assert "role_without_evidence" not in report["counts"]
    assert send(text, dry_run=True, columns={"code": "", "status": None})["good_rows"] == 8


def test_the_same_file_at_the_same_time_is_stored_once(database: Database, send: Send) -> None:
    """The second import is checked again when it may write: another one may have been stored since its first check."""
    reports: list[ImportReport] = []

    def meanwhile(progress: float) -> None:
        if progress >= SETTLED:
            reports.append(send(_csv()))

    report = send(_csv(), step=meanwhile)
    assert reports[0]["stored"] == 8
    assert (report["outcome"], report["stored"]) == ("refused", 0)
    assert report["counts"]["file_already_imported"] == 1


def test_a_local_grid_is_declared_and_reported(send: Send, database: Database) -> None:
    places = ((457000.0, 5428000.0, 0.0, 0.0), (457300.0, 5428400.0, 500.0, 0.0))  # turned by atan2(400, 300)
    names = ("easting", "northing", "local_easting", "local_northing")
    points = [{"point": f"C{k}", **dict(zip(names, place, strict=True))} for k, place in enumerate(places)]
    text = b"point,easting,northing\nM1,5.000,0.000\nM2,10.000,0.000\n"
    report = send(text, local_grid={"control_points": points})
    assert report["stored"] == 2
    assert report["local_grid"] is not None
    assert report["local_grid"]["rotation_deg"] == pytest.approx(53.1301024, abs=1e-6)
    assert report["local_grid"]["max_m"] == 0.0
    assert report["crs"] == "EPSG:25832"
    query = sa.select(markers.c.original, markers.c.lon_deg).where(
        markers.c.survey_file_sha256 == report["file_sha256"]
    )
    with database.read() as connection, seeing_every_agency(connection):
        (original, lon_deg), _second = connection.execute(query.order_by(markers.c.id)).all()
    assert (original["local_easting_m"], original["local_northing_m"]) == (5.0, 0.0)
    to_degrees = Transformer.from_crs("EPSG:25832", "EPSG:4258", always_xy=True).transform
    assert lon_deg == pytest.approx(to_degrees(457003.0, 5428004.0)[0], abs=2e-5)  # ETRS89 is 0.6 m from it
    with pytest.raises(InvalidParameter, match="do not fit each other"):
        send(text, local_grid={"control_points": [{**points[0], "easting": 456999.0}, points[1]]})

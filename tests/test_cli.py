"""The other commands of `waymark`, in this process."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import orjson
import pytest
from pydantic import SecretStr

from app import __version__, cli
from app.main import create_app
from app.markers.plate import PlateCode, PlateScheme
from app.settings import Settings
from tests.conftest import ADMIN_KEY, LiveServer

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def waymark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    monkeypatch.setenv("WAYMARK_DATA_DIR", str(tmp_path))

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["waymark", *arguments])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        printed = capsys.readouterr()
        return int(ended.value.code or 0), printed.out, printed.err

    return run


def test_migrate_up_and_down(waymark: Run, tmp_path: Path) -> None:
    assert "is at revision head" in waymark("migrate")[1]
    assert "is at revision base" in waymark("migrate", "base")[1]
    assert (tmp_path / "waymark.sqlite3").exists()


@pytest.mark.slow
def test_a_key_for_another_agency(waymark: Run, tmp_path: Path) -> None:
    status, key, _ = waymark("key", "City of Elsewhere", "--scope", "viewer", "--label", "map")
    assert status == 0
    with (
        LiveServer(create_app(Settings(data_dir=tmp_path, warm_decoders=False))) as server,
        server.client(key.strip()) as client,
    ):
        assert client.get("/v1/markers").status_code == 200
        assert client.post("/v1/markers", json={}).status_code == 403
        status, other, _ = waymark("key", "City", "--days", "3")
        assert status == 0
        with server.client(other.splitlines()[-1]) as second:
            assert second.get("/v1/markers").json()["items"] == []
    status, _, error = waymark("key", "City", "--scope", "everything")
    assert status == 1
    assert "admin, planner, surveyor, viewer, vehicle" in error


@pytest.mark.slow
def test_an_operators_key_is_made_before_and_beside_the_server(waymark: Run, tmp_path: Path) -> None:
    status, key, _ = waymark("key", "--operator", "--label", "ops")  # on an empty database: it is no agency
    assert status == 0
    settings = Settings(data_dir=tmp_path, warm_decoders=False, admin_key=SecretStr(ADMIN_KEY))
    with LiveServer(create_app(settings)) as server, server.client(key.strip()) as operator:
        assert [agency["name"] for agency in operator.get("/v1/agencies").json()["items"]] == ["default"]
        with server.client(ADMIN_KEY) as admin:
            assert admin.get("/v1/me").json()["agency"] == "default"
        status, second, _ = waymark("key", "--operator")
        with server.client(second.splitlines()[-1]) as other:
            assert other.post("/v1/agencies", json={"name": "Roads"}).status_code == 201
        assert "an agency's or an operator's" in waymark("key")[2]
        assert "an agency's or an operator's" in waymark("key", "Roads", "--operator")[2]
        assert "an agency's or an operator's" in waymark("key", "--operator", "--scope", "admin")[2]
        assert "reserved" in waymark("key", "(operators)", "--scope", "admin")[2]
    assert "(operators): 3 entries" in waymark("audit", "verify")[1]


@pytest.mark.slow
def test_the_admin_key_of_the_environment_can_change(tmp_path: Path) -> None:
    old, new = "an-old-admin-key-of-32-characters", "a-newer-admin-key-of-33-characters"
    for current, other in ((old, new), (new, old), (old, new)):
        settings = Settings(data_dir=tmp_path, admin_key=SecretStr(current), warm_decoders=False)
        with LiveServer(create_app(settings)) as server, server.client(current) as good, server.client(other) as bad:
            assert good.get("/v1/markers").status_code == 200
            assert bad.get("/v1/markers").status_code == 401


@pytest.mark.parametrize(
    ("name", "value"),
    [("WAYMARK_PORT", "70000"), ("WAYMARK_ADMIN_KEY", "short"), ("WAYMARK_DATABASE_URL", "mysql://x/y")],
)
def test_wrong_settings_are_named(waymark: Run, monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(name, value)
    status, _, error = waymark("migrate")
    assert status == 1
    assert name.removeprefix("WAYMARK_").lower() in error.lower()


def test_the_version_is_printed(waymark: Run) -> None:
    assert waymark("--version") == (0, f"waymark {__version__}\n", "")


def test_without_a_command_the_commands_are_listed(waymark: Run) -> None:
    status, out, error = waymark()
    assert status in (0, 2)
    assert all(name in out + error for name in ("serve", "migrate", "key"))


@pytest.mark.parametrize(
    ("scheme", "digits"),
    [
        ((), PlateCode.from_position(114.179203, 22.304161, n=10, scheme=PlateScheme.POSITION_ROBUST).digits),
        (("--scheme", "position"), "179203304161"),
    ],
)
def test_a_plate_is_written_and_read_back(waymark: Run, tmp_path: Path, scheme: tuple[str, ...], digits: str) -> None:
    out = tmp_path / "artwork"
    place = ("--lon-deg", "114.179203", "--lat-deg", "22.304161", *scheme)
    formats = ("--format", "png", "--format", "svg", "--format", "pdf", "--format", "dxf")
    status, listed, error = waymark("encode", *place, *formats, "--out", str(out))
    assert status == 0, error
    names = {f"{digits}.{form}" for form in ("png", "svg", "pdf", "dxf")}
    assert {Path(line).name for line in listed.split()} == names == {file.name for file in out.iterdir()}
    seen = tmp_path / "seen.png"
    drawn = cv2.imread(str(out / f"{digits}.png"))
    cv2.imwrite(str(seen), cv2.resize(drawn, (300, 356), interpolation=cv2.INTER_AREA))
    status, printed, error = waymark("decode", str(seen), str(seen))
    assert status == 0, error
    for line in printed.splitlines():
        assert [reading["digits"] for reading in orjson.loads(line)["readings"]] == [digits]


@pytest.mark.slow
def test_the_artwork_of_a_plate_is_a_perfect_print(waymark: Run, tmp_path: Path) -> None:
    place = ("--lon-deg", "114.179203", "--lat-deg", "22.304161")
    scheme = ("--scheme", "position")
    assert waymark("encode", *place, *scheme, "--format", "png", "--out", str(tmp_path))[0] == 0
    photo, page = str(tmp_path / "179203304161.png"), tmp_path / "grade.pdf"
    status, printed, error = waymark("grade-print", photo, *scheme, "--digits", "179203304161", "--pdf", str(page))
    assert status == 0, error
    grade = orjson.loads(printed)
    assert grade["letter"] == "A", grade["parameters"]
    values = {one["name"]: one["value"] for one in grade["parameters"]}
    assert values["axial-nonuniformity"] < 0.003
    assert values["grid-nonuniformity"] < 0.01
    assert values["print-growth"] < 0.1
    assert page.read_bytes().startswith(b"%PDF-")
    status, printed, error = waymark("grade-print", photo, "--digits", "1792")
    assert (status, printed) == (1, "")
    assert "12 digits" in error
    assert waymark("grade-print", photo, "--scheme", "morse", "--digits", "1")[0] == 1


def test_an_id_plate_is_written(waymark: Run, tmp_path: Path) -> None:
    number = ("--registry-number", "3735928559", "--format", "svg")
    status, listed, error = waymark("encode", *number, "--out", str(tmp_path))
    assert status == 0, error
    assert Path(listed.strip()).name.startswith("DEADBEEF")


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        ((), "--registry-number"),
        (("--lon-deg", "1", "--lat-deg", "91"), "lat_deg"),
        (("--lon-deg", "nan", "--lat-deg", "1"), "lon_deg"),
        (("--registry-number", "1", "--lon-deg", "1", "--lat-deg", "1"), "one of the two"),
        (("--registry-number", "4294967296"), "4294967295"),
        (("--registry-number", "1", "--n", "9"), "8, 10 or 12"),
        (("--lon-deg", "1", "--lat-deg", "1", "--n", "8"), "10 or 12"),
        (("--lon-deg", "1", "--lat-deg", "1", "--scheme", "id"), "position-robust"),
        (("--lon-deg", "1", "--lat-deg", "1", "--check-digits", "1"), "position-check"),
        (("--registry-number", "1", "--unit-mm", "51"), "2-5 cm"),
        (("--registry-number", "1", "--format", "gif"), "svg, pdf, dxf, png"),
    ],
)
def test_plates_that_cannot_be(waymark: Run, tmp_path: Path, arguments: tuple[str, ...], what: str) -> None:
    status, _, error = waymark("encode", *arguments, "--out", str(tmp_path / "none"))
    assert status == 1
    assert what in error
    assert not (tmp_path / "none").exists()


def test_a_file_that_is_no_picture(waymark: Run, tmp_path: Path) -> None:
    file = tmp_path / "x.jpg"
    file.write_bytes(b"ffconcat version 1.0\nfile other.avi\n")
    status, out, error = waymark("decode", str(file))
    assert (status, out) == (1, "")
    assert error.startswith("waymark: ")


def test_a_calibration_board(waymark: Run, tmp_path: Path) -> None:
    status, printed, _ = waymark("board", "--out", str(tmp_path / "b"), "--format", "svg", "--format", "pdf")
    assert status == 0
    names = [Path(line).name for line in printed.split()]
    assert names == ["waymark-board-7x10-25mm.svg", "waymark-board-7x10-25mm.pdf"]
    assert (tmp_path / "b" / "waymark-board-7x10-25mm.pdf").read_bytes().startswith(b"%PDF")
    for arguments, limit in ((["--columns", "3"], "4 to 24"), (["--format", "gif"], "svg, pdf, dxf, png")):
        status, _, error = waymark("board", "--out", str(tmp_path), *arguments)
        assert status == 1
        assert limit in error


SURVEY = "number,lon,lat\n" + "".join(f"{k},{8.4 + k * 1e-4:.7f},49.0000{k % 3}1\n" for k in range(1, 9))
DECLARED = '{"crs": "EPSG:4326", "family": "cerpm", "columns": {"code": "number"}}'


def test_a_survey_goes_in_and_markers_come_out(waymark: Run, tmp_path: Path) -> None:
    survey, out = tmp_path / "survey.csv", tmp_path / "markers.geojson"
    survey.write_text(SURVEY)
    waymark("key", "Roads")
    arguments = ("import", str(survey), "--agency", "Roads", "--declaration", DECLARED)
    status, printed, _ = waymark(*arguments, "--dry-run")
    assert (status, orjson.loads(printed)["outcome"], orjson.loads(printed)["stored"]) == (0, "checked", 0)
    status, printed, shown = waymark(*arguments)
    assert (status, orjson.loads(printed)["stored"]) == (0, 8)
    assert shown.endswith("check: 100%\nstore: 100%, 8 of 8\n")
    status, printed, _ = waymark(*arguments)
    assert (status, orjson.loads(printed)["counts"]["file_already_imported"]) == (1, 1)
    status, printed, shown = waymark("export", str(out), "--agency", "Roads", "--format", "geojson")
    assert (status, printed.strip(), shown) == (0, str(out), "export: 100%, 8 of 8\n")
    assert len(orjson.loads(out.read_bytes())["features"]) == 8
    assert not list(tmp_path.glob(".waymark-*"))
    compare = '{"crs": "EPSG:4326", "family": "cerpm", "columns": {"code": "number"}, "compare": true}'
    drawn = tmp_path / "residuals.svg"
    status, printed, _ = waymark(*arguments[:-1], compare, "--dry-run", "--map", str(drawn))
    assert (status, orjson.loads(printed)["comparison"]["matched"]) == (0, 8)
    assert drawn.read_text().startswith("<svg")


@pytest.mark.slow
def test_commands_print_json_and_nothing_else(waymark: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    survey, out, backup = tmp_path / "survey.csv", tmp_path / "out.geojson", tmp_path / "backup.tar"
    survey.write_text(SURVEY)
    waymark("key", "Roads")

    def printed(*arguments: str) -> dict[str, Any]:
        status, text, error = waymark(*arguments, "--json")
        assert (status, error) == (0, ""), error
        return dict(orjson.loads(text))

    found = printed("import", str(survey), "--agency", "Roads", "--declaration", DECLARED)
    assert found["outcome"] == "stored"
    found = printed("export", str(out), "--agency", "Roads", "--format", "geojson")
    assert found == {"file": str(out), "left_out": []}
    written = printed("backup", str(backup))
    assert {table["name"]: table["rows"] for table in written["manifest"]["tables"]}["markers"] == 8
    assert printed("backup", str(backup), "--verify") == written
    monkeypatch.setenv("WAYMARK_DATA_DIR", str(tmp_path / "restored"))
    restored = printed("restore", str(backup))
    assert restored["faults"] == []
    assert restored["manifest"] == written["manifest"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (("import", "SURVEY", "--agency", "Nobody", "--declaration", DECLARED), "there is no agency 'Nobody'"),
        (("import", "SURVEY", "--agency", "Roads", "--declaration", '{"family": "dragon"}'), "--declaration family"),
        (("import", "SURVEY", "--agency", "Roads", "--declaration", "{"), "--declaration"),
        (("export", "OUT", "--agency", "Roads", "--format", "exe"), "there is no format 'exe'"),
        (("export", "SURVEY", "--agency", "Roads"), "already exists"),
        (("export", "OUT", "--agency", "Roads", "--bbox", "1,2"), "bbox"),
        (("export", "OUT", "--agency", "Roads", "--format", "gpkg"), "no marker is in the selection"),
    ],
)
def test_imports_and_exports_that_cannot_be(
    waymark: Run, tmp_path: Path, arguments: tuple[str, ...], what: str
) -> None:
    (tmp_path / "survey.csv").write_text(SURVEY)
    waymark("key", "Roads")
    places = {"SURVEY": str(tmp_path / "survey.csv"), "OUT": str(tmp_path / "out.gpkg")}
    status, _, said = waymark(*(places.get(argument, argument) for argument in arguments))
    assert status == 1
    assert what in said
    assert not (tmp_path / "out.gpkg").exists()


@pytest.mark.parametrize(
    ("declared", "what"),
    [
        ("{", "--declaration"),
        ("[]", "--declaration"),
        ('{"bar": 5}', "--declaration bar"),
        ('{"bar": {"clearance_m": "abc"}}', "--declaration bar.clearance_m"),
        ('{"bar": {"clearance_m": 9}}', "--declaration bar.clearance_m"),
        ('{"bar": {"forward_m": "abc"}}', "--declaration bar.forward_m"),
        ('{"clearance_m": 0.3}', "--declaration clearance_m"),
    ],
)
def test_wrong_declarations_of_traces_are_refused(waymark: Run, tmp_path: Path, declared: str, what: str) -> None:
    recording = tmp_path / "drive.bin"
    recording.write_bytes(b"1")
    status, printed, error = waymark("decode-trace", str(recording), "--declaration", declared)
    assert (status, printed) == (1, "")
    assert what in error
    assert "docs/magnets.md" in error


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["sqlite", "postgresql"], scope="module")
def test_a_snapshot_is_made_and_verified(
    waymark: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, new_database_url: Callable[[Path], str]
) -> None:
    monkeypatch.setenv("WAYMARK_DATABASE_URL", new_database_url(tmp_path))
    survey, out = tmp_path / "survey.csv", tmp_path / "area.waymark"
    survey.write_text(SURVEY)
    waymark("key", "Roads")
    waymark("import", str(survey), "--agency", "Roads", "--declaration", DECLARED)
    box = "8.40005,48.9,8.40045,49.1"
    status, printed, _ = waymark("snapshot", "make", str(out), "--agency", "Roads", "--bbox", box, "--hours", "2")
    assert (status, printed) == (0, f"{out}: {out.stat().st_size} bytes\n")
    trust, memory = tmp_path / "trust.json", tmp_path / "newest.json"
    assert waymark("snapshot", "trust", str(trust), "--agency", "Roads")[:2] == (0, f"{trust}: 1 trusted key\n")
    for more in ((), ("--memory", str(memory))):
        status, printed, _ = waymark("snapshot", "verify", str(out), "--trust", str(trust), *more)
        assert status == 0
        held = orjson.loads(printed)
        assert (held["markers"], held["retired_cerpms"]) == ({"cerpm": 4}, 0)
        assert held["bbox_deg"] == [8.40005, 48.9, 8.40045, 49.1]
        ends = [datetime.fromisoformat(held[name]) for name in ("made_at", "expires_at")]
        assert ends[1] - ends[0].replace(microsecond=0) == timedelta(hours=2)
    newer = tmp_path / "newer.waymark"
    waymark("snapshot", "make", str(newer), "--agency", "Roads", "--bbox", box)
    verify = ("snapshot", "verify", "--trust", str(trust), "--memory", str(memory))
    assert waymark(*verify, str(newer))[0] == 0
    status, printed, said = waymark(*verify, str(out))
    assert (status, printed) == (1, "")
    assert "before one that was already accepted" in said
    out.write_bytes(out.read_bytes()[:-1] + bytes([out.read_bytes()[-1] ^ 1]))
    status, printed, said = waymark(*verify, str(out))
    assert (status, printed) == (1, "")
    assert "changed or damaged" in said
    trust.write_text("{}")
    assert "not a trust file" in waymark(*verify, str(newer))[2]
    trust.write_text("no")
    assert "is not JSON" in waymark(*verify, str(newer))[2]


@pytest.mark.slow
def test_a_rotation_of_signing_keys(waymark: Run, tmp_path: Path) -> None:
    """The drill of docs/snapshots.md, section Keys: no vehicle that follows it is without a valid snapshot."""
    waymark("key", "Roads")
    trusts = [tmp_path / f"trust-{step}.json" for step in range(3)]
    files = [tmp_path / f"area-{step}.waymark" for step in range(3)]

    def make(step: int) -> None:
        assert waymark("snapshot", "make", str(files[step]), "--agency", "Roads", "--bbox", "8,48,9,50")[0] == 0

    def install(step: int) -> None:
        assert waymark("snapshot", "trust", str(trusts[step]), "--agency", "Roads")[0] == 0

    def accepted(trust: int) -> list[bool]:
        made = [file for file in files if file.exists()]
        return [waymark("snapshot", "verify", str(file), "--trust", str(trusts[trust]))[0] == 0 for file in made]

    install(0)
    make(0)
    assert "has only one key" in waymark("snapshot", "rotate", "switch")[2]
    assert "has only one key" in waymark("snapshot", "rotate", "remove")[2]
    status, keys, _ = waymark("snapshot", "rotate", "add")
    assert (status, len(keys.split())) == (0, 2)
    assert "two keys already" in waymark("snapshot", "rotate", "add")[2]
    install(1)
    make(1)
    assert [accepted(0), accepted(1)] == [[True, True], [True, True]]
    assert waymark("snapshot", "rotate", "switch")[1].split() == keys.split()[::-1]
    make(2)
    assert [accepted(0), accepted(1)] == [[True, True, False], [True, True, True]]
    assert waymark("snapshot", "rotate", "remove")[1].split() == keys.split()[1:]
    install(2)
    assert [accepted(0), accepted(1), accepted(2)] == [[True, True, False], [True] * 3, [False, False, True]]
    path = tmp_path / "signing.key"
    assert (path.stat().st_size, path.stat().st_mode & 0o077) == (32, 0)
    path.write_bytes(b"short")
    assert "is not a file of signing keys" in waymark("snapshot", "rotate", "add")[2]
    assert path.read_bytes() == b"short"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (("OUT", "--agency", "Nobody", "--bbox", "8,48,9,50"), "there is no agency 'Nobody'"),
        (("OUT", "--agency", "Roads", "--bbox", "1,2"), "bbox"),
        (("OUT", "--agency", "Roads", "--bbox", "8,48,9,50", "--hours", "0"), "cannot hold for 0 h"),
        (("OUT", "--agency", "Roads", "--bbox", "8,48,9,50", "--hours", "nan"), "cannot hold for nan h"),
        (("OUT", "--agency", "Roads", "--bbox", "8,48,9,50", "--hours", "169"), "cannot hold for 169 h"),
        (("FILE", "--agency", "Roads", "--bbox", "8,48,9,50"), "already exists"),
    ],
)
def test_snapshots_that_cannot_be(waymark: Run, tmp_path: Path, arguments: tuple[str, ...], what: str) -> None:
    waymark("key", "Roads")
    (tmp_path / "there").write_bytes(b"kept")
    places = {"OUT": str(tmp_path / "out"), "FILE": str(tmp_path / "there")}
    status, _, said = waymark("snapshot", "make", *(places.get(argument, argument) for argument in arguments))
    assert status == 1
    assert what in said
    assert not (tmp_path / "out").exists()
    assert (tmp_path / "there").read_bytes() == b"kept"

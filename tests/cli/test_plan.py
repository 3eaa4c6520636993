"""`waymark plan`: from a road and rules to a folder, or to a message and nothing."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path

import pytest
from click.testing import Result
from typer.testing import CliRunner

from app.cli import cli
from app.planning.outputs.plan_document import read_plan
from tests.planning.roads import bend, straight

DOCS = Path(__file__).resolve().parents[2] / "docs/plans"
RULES = "version: 1\nname: all\nplates: {}\nlines: {}\ncerpm: {spreading_factor: 7, interval_s: 1}\n"


def write_road(path: Path, *, local: bool = False, lon: float | None = None) -> Path:
    """A road of one lane of 557 m as GeoJSON, in degrees or in local metres."""
    lane = bend(150)
    points = [[x, y] for x, y in zip(lane.lon_deg[::5].tolist(), lane.lat_deg[::5].tolist(), strict=True)]
    if local:
        points = [[10.0 * k, 0.0] for k in range(60)]
    properties = {"speed_limit_kmh": 80, "width_m": 3.5}
    feature = {"type": "Feature", "geometry": {"type": "LineString", "coordinates": points}, "properties": properties}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    return path


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


@pytest.fixture
def rules(tmp_path: Path) -> Path:
    path = tmp_path / "rules.yaml"
    path.write_text(RULES)
    return path


def test_a_road_becomes_a_folder_with_all_files(tmp_path: Path, rules: Path) -> None:
    road, out = write_road(tmp_path / "b10.geojson"), tmp_path / "made/plan"
    result = run("plan", road, "--rules", rules, "--out", out, "--stakeout-crs", "EPSG:32632", "--stakeout-unit", "m")
    assert result.exit_code == 0, result.output
    plan = read_plan((out / "plan.json").read_bytes())
    assert plan.name == "b10"
    assert plan.findings
    assert plan.counts.keys() == {"plate", "magnet", "cerpm"}
    names = {path.name for path in out.iterdir()}
    assert names >= {
        "plan.json", "plan.geojson", "report.md", "bill.csv", "schedule.csv", "stakeout-pnezd.csv", "stakeout.xml",
        "stakeout.dxf", "stakeout.gpkg", "drawings.pdf", "cerpm-programs.csv", "map.osm", "map.xodr",
    }  # fmt: skip
    with (out / "bill.csv").open(newline="") as file:
        quantities = {row["item"]: row["quantity"] for row in csv.DictReader(file) if row["section"] == "material"}
    assert quantities["chip-enabled raised pavement marker"] == str(plan.counts["cerpm"])
    assert f"{plan.counts['plate']} plates" in result.stdout
    assert "incomplete: no unit cost given" in result.stdout.replace("\n", " ")
    report = (out / "report.md").read_text()
    assert all(f"| {finding.name} | {finding.verdict.value} |" in report for finding in plan.findings)
    assert [path for path in out.parent.iterdir() if path != out] == [], "no temporary folder is left"
    again = run("plan", road, "--rules", rules, "--out", out, "--name", "second")
    assert again.exit_code == 0, again.output
    assert read_plan((out / "plan.json").read_bytes()).name == "second"


def test_artwork_and_sheets_are_written_on_request(tmp_path: Path) -> None:
    rules = tmp_path / "rules.yaml"
    rules.write_text("version: 1\nplates: {}\nlines: {}\n")
    out = tmp_path / "plan"
    result = run("plan", write_road(tmp_path / "b10.geojson"), "--rules", rules, "--out", out, "--artwork")
    assert result.exit_code == 0, result.output
    manifest = json.loads((out / "manifest.json").read_bytes())
    written = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    assert written == {entry["name"] for entry in manifest["files"]} | {"manifest.json"}
    for entry in manifest["files"]:
        assert hashlib.sha256((out / entry["name"]).read_bytes()).hexdigest() == entry["sha256"]
    assert len(list(out.glob("artwork/plate-*.pdf"))) == read_plan((out / "plan.json").read_bytes()).counts["plate"]
    assert list(out.glob("drilling/line-*.pdf"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rural-plates", "city-magnets", "work-zone-cerpms"])
def test_the_examples_plan_a_road_of_their_speed(name: str, tmp_path: Path) -> None:
    lane = straight(400)
    line = [[x, y] for x, y in zip(lane.lon_deg[::100].tolist(), lane.lat_deg[::100].tolist(), strict=True)]
    feature = {"type": "Feature", "geometry": {"type": "LineString", "coordinates": line}, "properties": {}}
    road = tmp_path / "road.geojson"
    road.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    result = run("plan", road, "--rules", DOCS / f"rules-{name}.yaml", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out/bill.csv").exists()


def test_local_coordinates_need_an_origin_and_are_marked_as_not_surveyed(tmp_path: Path, rules: Path) -> None:
    road, out = write_road(tmp_path / "local.geojson", local=True), tmp_path / "out"
    assert run("plan", road, "--rules", rules, "--out", out).exit_code == 2
    assert not out.exists()
    result = run("plan", road, "--rules", rules, "--out", out, "--origin", "-77.1,38.9", "--bearing", "45")
    assert result.exit_code == 0, result.output
    assert "not surveyed" in result.stdout
    plan = read_plan((out / "plan.json").read_bytes())
    assert not plan.alignment.surveyed
    assert plan.markers[0].lon_deg == pytest.approx(-77.1, abs=0.001)
    assert "NOT SURVEYED" in (out / "stakeout-README.txt").read_text()


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"rules": "version: 1\nplates: {spacing: 100}"}, "cure: write 'spacing_m'"),
        ({"rules": "version: 1\nplates: {}\nplates: {}"}, "duplicate key"),
        ({"rules": "version: 1\napplies: {speed_kmh: [20, 50]}\nplates: {}"}, "limit: 20 to 50 km/h"),
        ({"rules": "version: 1\nlines: {solid: null, dashed: S}"}, "no marker"),
        ({"road": "nothing"}, "waymark:"),
        ({"road": '{"type": "FeatureCollection", "features": []}'}, "waymark:"),
        ({"more": ["--origin", "here"]}, "LON,LAT"),
        ({"more": ["--stakeout-crs", "EPSG:4326"]}, "a projected system"),
        ({"more": ["--stakeout-unit", "rod"]}, "rod"),
        ({"more": ["--scale", "300"]}, "there is no scale 1 : 300"),
        ({"more": ["--crs", "EPSG:1"]}, "EPSG:1"),
        ({"out": "file"}, "a new or empty folder"),
    ],
)
def test_bad_input_ends_with_status_2_and_nothing_is_written(
    change: dict[str, object], part: str, tmp_path: Path, rules: Path
) -> None:
    road, out = write_road(tmp_path / "road.geojson"), tmp_path / "out"
    if "rules" in change:
        rules.write_text(str(change["rules"]))
    if "road" in change:
        road.write_text(str(change["road"]))
    if "out" in change:
        out.mkdir()
        (out / "letter.txt").write_text("mine")
    more = change.get("more", [])
    assert isinstance(more, list)
    before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    result = run("plan", road, "--rules", rules, "--out", out, *more)
    assert result.exit_code == 2, result.output
    assert part in result.stderr
    assert "Traceback" not in result.output
    assert {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")} == before


def test_rules_with_a_quality_get_the_cheapest_places_and_their_trade_off(tmp_path: Path) -> None:
    out = tmp_path / "plan"
    result = run(
        "plan", write_road(tmp_path / "road.geojson"), "--rules", DOCS / "rules-rural-plates.yaml", "--out", out
    )
    assert result.exit_code == 0, result.output
    assert "cheapest plan found for a fix every 100 m" in " ".join(result.stdout.split())
    with (out / "trade-off.csv").open(newline="") as file:
        required, *others = csv.DictReader(file)
    assert required["required"] == "yes"
    assert {row["required"] for row in others} == {"no"}
    assert float(required["cost"]) > float(required["bound"]) * 0.99 > 0
    assert (out / "trade-off.svg").read_text().startswith("<svg")


def test_a_quality_without_unit_costs_is_refused(tmp_path: Path, rules: Path) -> None:
    rules.write_text(RULES + "quality: {fix_every_m: 100}\n")
    result = run("plan", write_road(tmp_path / "road.geojson"), "--rules", rules, "--out", tmp_path / "plan")
    assert result.exit_code == 2
    assert "there is no unit cost for the family plate" in " ".join(result.output.split())
    assert not (tmp_path / "plan").exists()

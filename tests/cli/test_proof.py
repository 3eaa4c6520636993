"""`waymark proof`: files, resuming, the same with more processes, and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from app.cli import cli
from app.planning.outputs.plan_document import write_plan
from app.planning.placement import place_plan
from app.planning.rules import PlanRules
from tests.planning.roads import road, straight

pytestmark = pytest.mark.slow


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a plan of six plates."""
    rules = PlanRules.model_validate({"version": 1, "plates": {"spacing_m": 50}})
    plan = place_plan(road(straight(300, speed_kmh=50.0)), rules, name="short")
    (tmp_path / "plan.json").write_bytes(write_plan(plan))
    return tmp_path


def prove(folder: Path, *options: str) -> tuple[int, str]:
    result = CliRunner().invoke(cli, ["proof", str(folder), "--drives", "2", "--workers", "1", *options])
    return result.exit_code, result.output


def test_a_proof_writes_its_files_and_goes_on_after_an_interruption(folder: Path) -> None:
    code, text = prove(folder, "--conditions", "day, night")
    assert code == 0, text
    assert "weak markers: 0; wrong readings: 0" in text
    first = (folder / "proof.json").read_bytes()
    document = json.loads(first)
    assert (document["format"], document["complete"]) == ("waymark-proof/1", True)
    assert [rate["condition"] for rate in document["rates"]] == ["all", "day", "night"]
    rows = (folder / "proof.csv").read_text().splitlines()
    assert rows[0].startswith("number,code,kind,lane")
    assert len(rows) == 1 + 6
    units = (folder / "proof-units.jsonl").read_bytes().split(b"\n")
    assert len(units) == 1 + 4 + 1  # header, two units a drive, end of the file
    fake = json.loads(units[2])
    for one in fake["passes"]:
        one["read"] = 0
    cut = b"\n".join([*units[:2], json.dumps(fake).encode(), units[3][:40]])
    (folder / "proof-units.jsonl").write_bytes(cut)  # the third result was being written
    assert prove(folder, "--conditions", "day, night")[0] == 0
    again = json.loads((folder / "proof.json").read_bytes())
    missed = len(fake["passes"])
    assert again["rates"][0]["read"] == document["rates"][0]["read"] - missed  # what the file had was not driven again
    assert len((folder / "proof-units.jsonl").read_bytes().splitlines()) == 5
    assert prove(folder, "--conditions", "night, day")[0] == 0  # other terms start again
    assert json.loads((folder / "proof.json").read_bytes())["rates"][0]["read"] == 12


def test_two_processes_give_the_same_as_one(folder: Path) -> None:
    assert prove(folder)[0] == 0
    one = (folder / "proof.json").read_bytes()
    (folder / "proof-units.jsonl").unlink()
    code, text = prove(folder, "--workers", "2")
    assert code == 0, text
    assert (folder / "proof.json").read_bytes() == one


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--conditions", "fog"), "conditions"),
        (("--drives", "0"), "drives"),
        (("--lost", "1.5"), "lost_share"),
        (("--speed", "nan"), "speed_share"),
    ],
)
def test_refused_options_name_themselves_and_their_limits(folder: Path, options: tuple[str, ...], named: str) -> None:
    code, text = prove(folder, *options)
    assert code == 2
    assert f"field: {named}" in text
    assert "limit:" in text
    assert not (folder / "proof.json").exists()


def test_a_folder_without_a_plan_is_refused(tmp_path: Path) -> None:
    code, text = prove(tmp_path)
    assert code == 2
    assert "cure: make the plan with waymark plan" in text

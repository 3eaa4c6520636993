"""`waymark rules`."""

from __future__ import annotations

import json
from pathlib import Path

from typer.testing import CliRunner

from app.cli import cli

DOCS = Path(__file__).resolve().parents[2] / "docs/plans"


def test_the_schema_is_printed() -> None:
    run = CliRunner().invoke(cli, ["rules", "schema"])
    assert run.exit_code == 0
    assert json.loads(run.stdout) == json.loads((DOCS / "rules.schema.json").read_text("utf-8"))


def test_rules_are_checked(tmp_path: Path) -> None:
    run = CliRunner().invoke(cli, ["rules", "check", str(DOCS / "rules-city-magnets.yaml")])
    assert run.exit_code == 0
    assert json.loads(run.stdout)["lines"]["max_spacing_m"] == 6.0
    bad = tmp_path / "rules.yaml"
    bad.write_text("version: 1\nplates: {n: 9, spacing: 3}\n")
    run = CliRunner().invoke(cli, ["rules", "check", str(bad)])
    assert run.exit_code == 2
    assert "field: plates.n" in run.stderr
    assert "limit: 8, 10, 12" in run.stderr
    assert "cure: write 'spacing_m'" in run.stderr

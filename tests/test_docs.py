"""What the documents say is what the code does."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.main import get_command

from app.cli import cli
from app.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])


def test_every_setting_is_documented_with_its_default() -> None:
    rows = re.findall(
        r"^\| `WAYMARK_(\w+)` \| (?:`(.*?)`)? ?\| (.+) \|$", (ROOT / "docs/settings.md").read_text(), re.M
    )
    documented = {name.lower(): (default, text) for name, default, text in rows}
    declared = {
        name: ("" if field.default in (None, "") else str(field.default), field.description)
        for name, field in Settings.model_fields.items()
    }
    assert documented == declared


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_documented_commands_targets_settings_and_files_exist(document: Path) -> None:
    text = document.read_text()
    commands = set(getattr(get_command(cli), "commands", {}))
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.M))
    settings = {f"WAYMARK_{name.upper()}" for name in Settings.model_fields}
    assert set(re.findall(r"`waymark ([a-z]+)", text)) <= commands
    assert set(re.findall(r"(?:`|^ +)make ([a-z]+)", text, re.M)) <= targets
    assert set(re.findall(r"WAYMARK_[A-Z_]+[A-Z]", text)) <= settings
    for path in re.findall(r"`((?:app|docs|tests|migrations|benchmarks|docker)/[\w./-]*)`", text):
        assert (ROOT / path).exists(), path


def test_links_lead_somewhere() -> None:
    for document in DOCUMENTS:
        for target in re.findall(r"\]\((?!https?://|#|mailto:)([^)#]+)", document.read_text()):
            assert (document.parent / target).exists(), f"{document.name}: {target}"

"""No cell of a table is a formula, whoever wrote its text."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import pytest

from app.formats.text import TableWriter, plain_text

APP = Path(__file__).resolve().parents[2] / "app"


@pytest.mark.parametrize(
    "text",
    [
        "=1+1",
        "+cmd|' /C calc'!A0",
        "-2+3",
        "@SUM(A1)",
        "\t=1",
        "\r=1",
        "\n=1",
        "＝1",
        "=HYPERLINK(1)",
        "-",
        "+1e",
        "--1",
    ],
)
def test_a_formula_becomes_text(text: str) -> None:
    stream = io.StringIO()
    TableWriter(stream).write_row([text, "plain", -1.5, None])
    ((cell, *others),) = csv.reader(io.StringIO(stream.getvalue(), newline=""))
    assert cell == f"'{text}"
    assert others == ["plain", "-1.5", ""]


@pytest.mark.parametrize("text", ["-1", "+2.50", "-1e-05", "-0.", "A1", "a=b", ""])
def test_numbers_and_other_texts_stay(text: str) -> None:
    assert plain_text(text) == text


def test_all_tables_are_written_by_it() -> None:
    """Simulated drives and the demo's files contain no text of users."""
    writers = {
        str(file.relative_to(APP))
        for file in APP.rglob("*.py")
        if re.search(r"csv\.(Dict)?[wW]riter\(", file.read_text())
    }
    assert writers == {"formats/text.py", "simulation/radio/drive.py", "demo/run.py"}

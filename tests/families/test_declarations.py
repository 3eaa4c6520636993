"""Declarations of families, and the page that describes how one is added."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest

from app.families import FAMILIES, FAMILY_NAMES
from app.families.family import Family
from app.registry.marker_rows import markers

ROOT = Path(__file__).parents[2]


def test_the_page_describes_every_member_of_a_declaration() -> None:
    declared = {name for name in inspect.get_annotations(Family) if not name.startswith("_")}
    declared |= {name for name, value in vars(Family).items() if inspect.isfunction(value) and name[0] != "_"}
    table = (ROOT / "docs/add-a-family.md").read_text().partition("## Members of a declaration")[2]
    described = {name for row in re.findall(r"^\| (`.*?) \|", table, re.M) for name in re.findall(r"`(\w+)`", row)}
    assert described == declared


@pytest.mark.parametrize("family", FAMILIES, ids=FAMILY_NAMES)
def test_a_family_fits_the_table_and_its_examples_its_schema(family: Family) -> None:  # type: ignore[type-arg]
    assert len(family.name) <= markers.c.family.type.length  # type: ignore[attr-defined]
    assert family.examples
    for example in family.examples:
        new = family.schema.model_validate(example)
        assert new.family == family.name


def test_names_are_distinct_and_plates_come_first() -> None:
    assert len(set(FAMILY_NAMES)) == len(FAMILY_NAMES)
    assert FAMILY_NAMES[0] == "plate"  # requests that name no family are about plates

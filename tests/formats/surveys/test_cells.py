"""Numbers as people type them."""

from __future__ import annotations

import numpy as np
import pytest

from app.formats.surveys.table import NumberForm, detect_number_form, read_numbers


def test_plain_numbers_are_read_at_once_and_one_by_one() -> None:
    cells = ["1.5", " -2 ", "3e2", ".5"]
    values, faults = read_numbers(cells, "lon_deg", required=True)
    assert values.tolist() == [1.5, -2.0, 300.0, 0.5]
    slow, wrong = read_numbers([*cells, ""], "lon_deg", required=False)
    assert slow[:4].tolist() == values.tolist()
    assert np.isnan(slow[4])
    assert not faults
    assert not wrong


@pytest.mark.parametrize(
    ("cell", "code", "proposal"),
    [
        ("8,4164", "decimal_comma", "8.4164"),
        ("4,312,345.12", "grouped_digits", "4312345.12"),
        ("77.15W", "hemisphere_letter", "-77.15"),
        ("S 12.5", "hemisphere_letter", "-12.5"),
        ("12.5 ft", "unit_in_value", "12.5"),
        ("77°08'54\"W", "degrees_minutes", "-77.148333333"),
        ("-77 8 54", "degrees_minutes", "-77.148333333"),
        ("12.5 O", "hemisphere_letter", "Ost (east) or Ouest (west)"),
        ("8°24'36\"O", "degrees_minutes", "Ost (east) or Ouest (west)"),
        ("1_000", "not_a_number", ""),
        ("nan", "not_a_number", ""),
        ("inf", "not_a_number", ""),
        ("1e999", "not_a_number", ""),
        ("0x10", "not_a_number", ""),
        ("", "missing", ""),
    ],
)
def test_what_is_no_number_is_named(cell: str, code: str, proposal: str) -> None:
    values, faults = read_numbers(["1.0", cell], "lon_deg", required=True)
    assert np.isnan(values[1])
    assert [(fault.row, fault.code) for fault in faults] == [(2, code)]
    assert proposal in (faults[0].proposal or "")


def test_declared_decimal_commas_are_read() -> None:
    values, faults = read_numbers(["8,5", "-7,25"], "lon_deg", form=NumberForm(","), required=True)
    assert values.tolist() == [8.5, -7.25]
    assert not faults


@pytest.mark.parametrize(
    ("cells", "form", "values"),
    [
        (["456789.12", "5427345.001"], NumberForm(".", ""), [456789.12, 5427345.001]),
        (["456789,12", "5427345,001"], NumberForm(",", ""), [456789.12, 5427345.001]),
        (["456,789.12", "5,427,345.001", "112.3"], NumberForm(".", ","), [456789.12, 5427345.001, 112.3]),
        (["456.789,12", "5.427.345,001", "112,3"], NumberForm(",", "."), [456789.12, 5427345.001, 112.3]),
        (["456 789,12", "5 427 345,001"], NumberForm(",", " "), [456789.12, 5427345.001]),
        (["456\u00a0789.12", "5\u00a0427\u00a0345.001"], NumberForm(".", "\u00a0"), [456789.12, 5427345.001]),
        (["2'683'141.5", "1'247'945.2"], NumberForm(".", "'"), [2683141.5, 1247945.2]),
        (["8.416", "49.005"], NumberForm(".", ""), [8.416, 49.005]),
        (["4,312,345", "1,247,945"], NumberForm(".", ","), [4312345.0, 1247945.0]),
    ],
)
def test_the_form_of_numbers_is_detected(cells: list[str], form: NumberForm, values: list[float]) -> None:
    found, shown = detect_number_form(cells, None)
    assert found == form
    assert shown in cells
    read, faults = read_numbers(cells, "easting", form=found, required=True)
    assert read.tolist() == values
    assert not faults


def test_a_comma_before_three_digits_shows_nothing() -> None:
    assert detect_number_form(["432,345", "5,427"], None) == (NumberForm(), "")
    assert detect_number_form(["432,345", "5,427.5"], None)[0] == NumberForm(".", ",")
    assert detect_number_form(["432,345", "5,4275"], None)[0] == NumberForm(",", "")


def test_a_cell_in_another_form_than_the_majority_is_a_fault() -> None:
    cells = ["456789.12", "456,790.12", "456791.12", "456792,12"]
    form, _shown = detect_number_form(cells, None)
    _values, faults = read_numbers(cells, "easting", form=form, required=True)
    assert [(fault.row, fault.code) for fault in faults] == [(2, "grouped_digits"), (4, "decimal_comma")]


@pytest.mark.parametrize("cell", ["1.234", "300.5", "-1.234"])
def test_a_point_in_a_file_with_decimal_commas_is_ambiguous(cell: str) -> None:
    """It separates decimals or thousands; before, the height 1.234 of such a file was 1.234 m."""
    values, faults = read_numbers(["457000,12", cell], "height", form=NumberForm(","), required=True)
    assert values[0] == 457000.12
    assert np.isnan(values[1])
    assert [(fault.row, fault.code) for fault in faults] == [(2, "decimal_point")]
    assert read_numbers(["5.428.000,34", "1.234"], "height", form=NumberForm(",", "."), required=True)[0][1] == 1234
    assert read_numbers([1.234], "height", form=NumberForm(","), required=True)[0][0] == 1.234

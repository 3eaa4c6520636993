"""Two hundred planted faults: each makes a file and a declaration out of a clean survey."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pyproj import Transformer

from benchmarks.imports.surveys import EVIDENCE, LANES, Survey, make_survey

US_FT, FT = 1200 / 3937, 0.3048
Made = tuple[bytes, dict[str, Any]]
Plant = Callable[[Survey, np.random.Generator], Made]


@dataclass(frozen=True)
class Planted:
    """A fault in a file, beside the survey without it."""

    kind: str
    survey: Survey
    data: bytes
    declaration: dict[str, Any]


def plant_faults(seed: int, count: int = 200) -> Iterator[Planted]:
    """The set: every kind in turn, over lanes and evidence."""
    rng = np.random.default_rng(seed)
    made = 0
    while made < count:
        for kind, (plant, crs, evidence) in KINDS.items():
            if made == count:
                return
            lane = str(rng.choice([lane for lane in LANES if crs is None or lane[0] in crs]))
            chosen = crs[lane[0]] if crs is not None else None
            survey = make_survey(rng, lane, str(rng.choice(evidence)), str(rng.choice(chosen)) if chosen else None)
            data, declaration = plant(survey, rng)
            yield Planted(kind, survey, data, declaration)
            made += 1


def _values(survey: Survey, **values: Any) -> Made:
    changed = survey.with_values(**values)
    return changed.csv(), changed.declaration


def _declared(survey: Survey, **values: Any) -> Made:
    return survey.csv(), {**survey.declaration, **values}


def _row(survey: Survey, rng: np.random.Generator) -> int:
    return int(rng.integers(1, len(survey.codes) - 1))


def swapped_axes(survey: Survey, _rng: np.random.Generator) -> Made:
    """The header says the columns in the wrong order."""
    return _values(survey, first=survey.second, second=survey.first)


def wrong_sign(survey: Survey, rng: np.random.Generator) -> Made:
    """West or south without its minus, or one too many."""
    flip_first = rng.integers(2) == 0
    return _values(
        survey,
        first=-survey.first if flip_first else survey.first,
        second=survey.second if flip_first else -survey.second,
    )


def wrong_zone(survey: Survey, rng: np.random.Generator) -> Made:
    """The neighbouring zone is declared."""
    code = int(survey.crs[5:]) + int(rng.choice([-1, 1]))
    return _declared(survey, crs=f"EPSG:{code}")


def scaled(first: float, height: float = 1.0) -> Plant:
    """Coordinates in another unit."""

    def plant(survey: Survey, _rng: np.random.Generator) -> Made:
        return _values(
            survey, first=survey.first * first, second=survey.second * first, height_m=survey.height_m * height
        )

    return plant


def wrong_datum(survey: Survey, _rng: np.random.Generator) -> Made:
    """NAD27 or ED50 declared for what is NAD83 or ETRS89."""
    return _declared(survey, crs="EPSG:26718" if survey.lane.startswith("t") else "EPSG:23032")


def geoid_for_ellipsoid(survey: Survey, _rng: np.random.Generator) -> Made:
    """Heights above the geoid, declared as ellipsoidal."""
    return _values(survey, height_m=survey.height_m - survey.geoid_m)


def geoid_in_part(survey: Survey, rng: np.random.Generator) -> Made:
    """The second day's rows are above the geoid."""
    cut = int(rng.integers(len(survey.codes) // 3, 2 * len(survey.codes) // 3))
    height = survey.height_m.copy()
    height[cut:] -= survey.geoid_m
    return _values(survey, height_m=height)


def _packed(value: Any, *, minutes: bool) -> Any:
    magnitude = np.abs(value)
    degrees = np.floor(magnitude)
    minute = (magnitude - degrees) * 60
    if minutes:
        return np.sign(value) * (degrees * 100 + minute)
    whole = np.floor(minute)
    return np.sign(value) * (degrees + whole / 100 + (minute - whole) * 60 / 10000)


def degrees_minutes(survey: Survey, _rng: np.random.Generator) -> Made:
    """ddmm.mmmm as NMEA has it."""
    return _values(survey, first=_packed(survey.first, minutes=True), second=_packed(survey.second, minutes=True))


def degrees_minutes_seconds(survey: Survey, _rng: np.random.Generator) -> Made:
    """D.MMSSsss as total stations show it."""
    return _values(survey, first=_packed(survey.first, minutes=False), second=_packed(survey.second, minutes=False))


def degrees_text(survey: Survey, rng: np.random.Generator) -> Made:
    """One row as degrees, minutes, seconds with their signs."""
    rows = survey.cells()
    row = rows[_row(survey, rng)]
    value = abs(float(row[1]))
    minutes = value % 1 * 60
    row[1] = f"{int(value)}°{int(minutes)}'{minutes % 1 * 60:.3f}\"{'W' if row[1].startswith('-') else 'E'}"
    return survey.csv(rows), survey.declaration


def decimal_commas(survey: Survey, rng: np.random.Generator) -> Made:
    """Decimal commas: all rows beside commas, or one row; a file that has only such numbers is read as it is."""
    rows = survey.cells()
    how = int(rng.integers(3))
    one = rows[_row(survey, rng)] if how == 2 else rows[len(rows) // 2]
    for row in rows if how == 1 else [one]:
        row[1:] = [cell.replace(".", ",") for cell in row[1:]]
    return survey.csv(rows, delimiter="," if how == 1 else ";"), survey.declaration


def grouped_digits(survey: Survey, _rng: np.random.Generator) -> Made:
    """4,312,345.123 in one row, as spreadsheets write it; a file that has only such numbers is read as it is."""
    rows = survey.cells()
    row = rows[len(rows) // 2]
    row[1:3] = [f'"{float(cell):,.3f}"' for cell in row[1:3]]
    return survey.csv(rows), survey.declaration


def repeated_row(survey: Survey, rng: np.random.Generator) -> Made:
    """A row twice."""
    rows = survey.cells()
    rows.append(rows[_row(survey, rng)])
    return survey.csv(rows), survey.declaration


def repeated_code(survey: Survey, rng: np.random.Generator) -> Made:
    """Two places with one number."""
    rows = survey.cells()
    k = _row(survey, rng)
    rows[k][0] = rows[k - 1][0]
    return survey.csv(rows), survey.declaration


def repeated_place(survey: Survey, rng: np.random.Generator) -> Made:
    """One place with two numbers: a marker measured twice, another not at all."""
    rows = survey.cells()
    k = _row(survey, rng)
    rows[k][1:] = rows[k - 1][1:]
    return survey.csv(rows), survey.declaration


def taken_code(survey: Survey, rng: np.random.Generator) -> Made:
    """The number of a marker that is registered."""
    rows = survey.cells()
    rows[_row(survey, rng)][0] = survey.registered[0][0]
    return survey.csv(rows), survey.declaration


def moved_row(low_m: float, high_m: float) -> Plant:
    """One row by a typing error of this size."""

    def plant(survey: Survey, rng: np.random.Generator) -> Made:
        k = _row(survey, rng)
        angle, shift = rng.uniform(0, 2 * np.pi), np.exp(rng.uniform(np.log(low_m), np.log(high_m)))
        unit = US_FT if survey.crs == "EPSG:6593" else 1.0
        scale = (1 / unit, 1 / unit)
        if not survey.projected:
            scale = (1 / (111_195 * np.cos(np.radians(survey.lat_deg[k]))), 1 / 111_195)
        first, second = survey.first.copy(), survey.second.copy()
        first[k] += shift * np.cos(angle) * scale[0]
        second[k] += shift * np.sin(angle) * scale[1]
        return _values(survey, first=first, second=second)

    return plant


def transposed_digits(survey: Survey, rng: np.random.Generator) -> Made:
    """Two digits of a coordinate change places."""
    rows = survey.cells()
    row = rows[_row(survey, rng)]
    column = int(rng.integers(1, 3))
    text = row[column]
    point = text.index(".")
    places = range(1, point - 1) if survey.projected else range(point + 1, point + 4)
    pairs = [k for k in places if text[k].isdigit() and text[k + 1].isdigit() and text[k] != text[k + 1]]
    k = int(rng.choice(pairs)) if pairs else 1
    row[column] = text[:k] + text[k + 1] + text[k] + text[k + 2 :]
    return survey.csv(rows), survey.declaration


def dropped_digit(survey: Survey, rng: np.random.Generator) -> Made:
    """A digit of a coordinate is missing."""
    rows = survey.cells()
    row = rows[_row(survey, rng)]
    column = int(rng.integers(1, 3))
    k = row[column].index(".") + (-2 if survey.projected else 2)
    row[column] = row[column][:k] + row[column][k + 1 :]
    return survey.csv(rows), survey.declaration


def zero_row(survey: Survey, rng: np.random.Generator) -> Made:
    """A row without a fix is written as zeros."""
    rows = survey.cells()
    rows[_row(survey, rng)][1:] = ["0.0", "0.0", "0.0"]
    return survey.csv(rows), survey.declaration


def swapped_row(survey: Survey, rng: np.random.Generator) -> Made:
    """One row has its coordinates in the other order."""
    rows = survey.cells()
    row = rows[_row(survey, rng)]
    row[1], row[2] = row[2], row[1]
    return survey.csv(rows), survey.declaration


def bad_cell(survey: Survey, rng: np.random.Generator) -> Made:
    """Something that is no number."""
    rows = survey.cells()
    rows[_row(survey, rng)][int(rng.integers(1, 3))] = str(rng.choice(["", "nan", "#REF!", "inf", "1e999", "12.5 m"]))
    return survey.csv(rows), survey.declaration


def missing_field(survey: Survey, rng: np.random.Generator) -> Made:
    """A row lost a field, and the others moved up."""
    rows = survey.cells()
    del rows[_row(survey, rng)][int(rng.integers(0, 4))]
    return survey.csv(rows), survey.declaration


def wrong_height(survey: Survey, rng: np.random.Generator) -> Made:
    """One height: a decimal slipped, no data, a rod's height forgotten thrice over."""
    height = survey.height_m.copy()
    k = _row(survey, rng)
    height[k] = rng.choice([height[k] * 10, -9999.0, height[k] + 12.0, height[k] / 10])
    return _values(survey, height_m=height)


def shuffled_codes(survey: Survey, rng: np.random.Generator) -> Made:
    """The column of numbers was sorted by itself."""
    order = rng.permutation(len(survey.codes))
    return _values(survey, codes=[survey.codes[k] for k in order])


def ground_distances(survey: Survey, _rng: np.random.Generator) -> Made:
    """Grid coordinates scaled to the ground about the origin of the grid."""
    return _values(survey, first=survey.first * 1.0004, second=survey.second * 1.0004)


def cut_digits(survey: Survey, _rng: np.random.Generator) -> Made:
    """Leading digits left out, as crews do."""
    return _values(survey, first=survey.first % 10_000, second=survey.second % 10_000)


def rounded(survey: Survey, _rng: np.random.Generator) -> Made:
    """A spreadsheet showed, and saved, few decimals."""
    places = -1 if survey.projected else 4
    return _values(survey, first=np.round(survey.first, places), second=np.round(survey.second, places))


def second_header(survey: Survey, rng: np.random.Generator) -> Made:
    """Two files put together, header and all."""
    rows = survey.cells()
    rows.insert(_row(survey, rng), ["number", "easting", "northing", "height"])
    return survey.csv(rows), survey.declaration


def web_mercator(survey: Survey, _rng: np.random.Generator) -> Made:
    """Coordinates copied from a web map."""
    first, second = Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True).transform(
        survey.lon_deg, survey.lat_deg
    )
    return _values(survey, first=np.asarray(first), second=np.asarray(second))


_ANY = EVIDENCE
_DEGREES: Mapping[str, tuple[str, ...]] = {"k": ("EPSG:4326",), "t": ("EPSG:4326",)}
_METRES: Mapping[str, tuple[str, ...]] = {"k": ("EPSG:25832", "EPSG:32632"), "t": ("EPSG:26918", "EPSG:6347")}
_FEET: Mapping[str, tuple[str, ...]] = {"t": ("EPSG:6593",)}
_OLD: Mapping[str, tuple[str, ...]] = {"k": ("EPSG:25832",), "t": ("EPSG:26918",)}
_ZONES: Mapping[str, tuple[str, ...]] = {"k": ("EPSG:25832", "EPSG:32632"), "t": ("EPSG:26918",)}
KINDS: dict[str, tuple[Plant, Mapping[str, tuple[str, ...]] | None, tuple[str, ...]]] = {
    "swapped axes": (swapped_axes, None, _ANY),
    "wrong sign": (wrong_sign, _DEGREES, _ANY),
    "neighbouring zone": (wrong_zone, _ZONES, _ANY),
    "international feet for metres": (scaled(1 / FT), _METRES, _ANY),
    "US feet for metres": (scaled(1 / US_FT), _METRES, _ANY),
    "metres for US feet": (scaled(US_FT), _FEET, _ANY),
    "international for US feet": (scaled(US_FT / FT), _FEET, ("plan", "plan", "beside", "area")),
    "heights in feet": (scaled(1.0, 1 / FT), None, _ANY),
    "geoid for ellipsoid": (geoid_for_ellipsoid, None, _ANY),
    "geoid in part": (geoid_in_part, None, _ANY),
    "ddmm.mmmm": (degrees_minutes, _DEGREES, _ANY),
    "D.MMSS": (degrees_minutes_seconds, _DEGREES, _ANY),
    "degrees as text": (degrees_text, _DEGREES, _ANY),
    "decimal commas": (decimal_commas, None, _ANY),
    "grouped digits": (grouped_digits, _METRES, _ANY),
    "row twice": (repeated_row, None, _ANY),
    "number twice": (repeated_code, None, _ANY),
    "place twice": (repeated_place, None, _ANY),
    "number taken": (taken_code, None, ("beside",)),
    "row moved 10-40 m": (moved_row(10.5, 40), None, _ANY),
    "row moved 40-2000 m": (moved_row(40, 2000), None, _ANY),
    "digits transposed": (transposed_digits, None, _ANY),
    "digit dropped": (dropped_digit, None, _ANY),
    "zeros": (zero_row, None, _ANY),
    "row with swapped axes": (swapped_row, None, _ANY),
    "no number": (bad_cell, None, _ANY),
    "field missing": (missing_field, None, _ANY),
    "wrong height": (wrong_height, None, _ANY),
    "numbers shuffled": (shuffled_codes, None, ("plan",)),
    "wrong datum": (wrong_datum, _OLD, _ANY),
    "ground distances": (ground_distances, _METRES, _ANY),
    "leading digits cut": (cut_digits, _METRES, _ANY),
    "rounded coordinates": (rounded, None, _ANY),
    "second header": (second_header, None, _ANY),
    "web map coordinates": (web_mercator, _METRES, _ANY),
}

"""Rows of a survey become columns of markers, thousands at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from functools import lru_cache
from typing import Any

import numpy as np

from app.encoders.cerpm.settings import RadioSettings
from app.markers.cerpm import HEIGHT_M, LaneSide, SpeedLimit
from app.markers.plate import PlateGeometry, PlateScheme
from app.registry.columns import Columns, JsonTexts, json_objects
from app.registry.exchange.declaration import ImportDeclaration
from app.registry.exchange.place import PlacedSurvey
from app.registry.exchange.table import Fault, Floats, Texts
from app.services.cerpm_markers import speed_limit_document
from app.services.import_codes import RowCodes, Rows, read_cerpm_codes, read_id_codes, read_position_codes
from app.services.marker_rules import PLANNED

_STATUSES = ("planned", "built", "surveyed", "active", "suspect", "retired")
_EMPTY: dict[str, Any] = dict.fromkeys(
    ("scheme", "digits", "check_digits", "digits_match_position", "n", "unit_mm", "gap_mm", "thickness_mm", "spec")
)
_TEXTS = ("point", "description", "road", "status", "side")


@dataclass(frozen=True, slots=True)
class MarkerDefaults:
    """What a survey's markers have in common."""

    scheme: PlateScheme = PlateScheme.POSITION
    check_digits: int | None = None
    geometry: PlateGeometry = field(default_factory=PlateGeometry)
    side: LaneSide = LaneSide.UNKNOWN
    speed_limit: SpeedLimit | None = None

    @property
    def checks(self) -> int:
        """Check digits of position plates."""
        return (self.check_digits or 1) if self.scheme is PlateScheme.POSITION_CHECK else 0


def check_values(
    survey: PlacedSurvey, rows: Rows, declaration: ImportDeclaration, *, of_cerpms: bool
) -> Iterator[Fault]:
    """Rows that say what no marker can have: a status, heading, side or height."""
    texts, numbers = survey.table.texts, survey.table.numbers
    wanted = np.zeros(survey.table.rows, dtype=bool)
    wanted[rows] = True
    sides = {side.name for side in LaneSide}
    yield from _unknown_texts(texts.get("status"), wanted, "status", set(_STATUSES), ", ".join(_STATUSES))
    if of_cerpms:
        known = sides | {name.lower() for name in sides}
        yield from _unknown_texts(texts.get("side"), wanted, "side", known, "left, right, unknown")
    heading = numbers.get("heading_deg")
    if heading is not None:
        for row in np.flatnonzero(wanted & ((heading < 0) | (heading >= 360))):
            message, cure = f"the heading is {heading[row]:g}", "0 to 360 deg"
            yield Fault(int(row) + 1, "heading_deg", "not_a_marker", message, cure)
    if of_cerpms and declaration.vertical_datum in (None, "ellipsoid"):
        height = survey.placed.height_m
        cure = "leave the height out where it does not fit"
        for row in np.flatnonzero(wanted & ((height < HEIGHT_M[0]) | (height > HEIGHT_M[1]))):
            message = f"height_m is {height[row]:g}, a message holds {HEIGHT_M[0]:g} to {HEIGHT_M[1]:g} m"
            yield Fault(int(row) + 1, "position.height_m", "not_a_marker", message, cure)


def _unknown_texts(texts: Texts | None, wanted: Any, name: str, known: set[str], limit: str) -> Iterator[Fault]:
    start = 0
    for part in texts.parts() if texts is not None else ():
        if not known.issuperset(part):
            for k, text in enumerate(part, start):
                if text and text not in known and text.upper() not in known and wanted[k]:
                    yield Fault(k + 1, name, "not_a_marker", f"there is no {name} {text[:40]!r}", limit)
        start += len(part)


def read_codes(survey: PlacedSurvey, rows: Rows, family: str, defaults: MarkerDefaults) -> tuple[RowCodes, list[Fault]]:
    """Codes of these rows (indices from 0), and the faults of rows whose code cannot be."""
    if family == "cerpm":
        return read_cerpm_codes(survey, rows)
    if defaults.scheme is PlateScheme.ID:
        return read_id_codes(survey, rows, defaults.geometry)
    return read_position_codes(survey, rows, defaults.geometry, defaults.checks)


def marker_columns(
    survey: PlacedSurvey,
    codes: RowCodes,
    declaration: ImportDeclaration,
    defaults: MarkerDefaults,
    *,
    ids: list[str],
    now: datetime,
    file_sha256: str,
) -> Columns:
    """Columns of new markers."""
    common = common_columns(survey, codes.rows, declaration, file_sha256=file_sha256)
    same = {
        **_EMPTY,
        **common.same,
        **_family_columns(codes, declaration, defaults),
        "version": 1,
        "created_at": now,
        "updated_at": now,
    }
    own: dict[str, Sequence[Any]] = {"id": ids, "digits": [code.decode() for code in codes.digits.tolist()]}
    if declaration.family == "cerpm":
        specs = _specs(defaults)
        if "side" in survey.table.texts:
            own["spec"] = [specs[side.upper()] for side in _texts_of(survey, codes.rows, "side")]
        else:
            same["spec"] = specs[""]
    return Columns(len(ids), same, dict(common.own)).but(**own)


def _family_columns(codes: RowCodes, declaration: ImportDeclaration, defaults: MarkerDefaults) -> dict[str, Any]:
    if declaration.family == "cerpm":
        return {"scheme": codes.scheme}
    geometry = defaults.geometry
    return {
        "scheme": codes.scheme,
        "check_digits": defaults.checks or None,
        "digits_match_position": None if defaults.scheme is PlateScheme.ID else True,
        "n": geometry.n,
        "unit_mm": geometry.unit_mm,
        "gap_mm": geometry.gap_mm,
        "thickness_mm": geometry.thickness_mm,
    }


def _specs(defaults: MarkerDefaults) -> dict[str, dict[str, Any]]:
    """What CERPMs of each side keep; rows share these, and none changes them."""
    limit, radio = speed_limit_document(defaults.speed_limit), _default_radio()
    of_side = {
        side.name: {"side": side.name.lower(), "speed_limit": limit, "dev_eui": None, "radio": radio}
        for side in LaneSide
    }
    return {**of_side, "": of_side[defaults.side.name]}


@lru_cache
def _default_radio() -> dict[str, Any]:
    return asdict(RadioSettings())


def common_columns(survey: PlacedSurvey, rows: Rows, declaration: ImportDeclaration, *, file_sha256: str) -> Columns:
    """Columns that markers of every family have: place, provenance, road."""
    placed, said, texts, numbers = survey.placed, declaration.survey, survey.table.texts, survey.table.numbers
    same = {
        "family": declaration.family,
        "status": declaration.status or PLANNED,
        "road": declaration.road,
        "heading_deg": None,
        "heading_rmse_deg": None,
        "horizontal_rmse_m": said.get("horizontal_rmse_m"),
        "vertical_rmse_m": said.get("vertical_rmse_m"),
        "crs": placed.crs,
        "realization": placed.realization,
        "epoch": declaration.epoch,
        "survey_method": said.get("survey_method"),
        "check_points": said.get("check_points"),
        "surveyor": said.get("surveyor"),
        "instrument": said.get("instrument"),
        "survey_file_sha256": file_sha256,
        "transform_accuracy_m": placed.transform_accuracy_m,
        "localization_grade": str(placed.grade),
        "transform_note": placed.note,
        "measure_m": None,
        "offset_m": None,
    }
    heights, datum = _optional(placed.height_m, rows), declaration.vertical_datum
    own: dict[str, Sequence[Any]] = {
        "lon_deg": placed.lon_deg[rows].tolist(),
        "lat_deg": placed.lat_deg[rows].tolist(),
        "height_m": heights,
        "vertical_datum": [None if height is None else datum for height in heights],
        "original": _originals(survey, rows, declaration, file_sha256),
    }
    for name in ("status", "road"):
        if name in texts:
            own[name] = [text or same[name] for text in _texts_of(survey, rows, name)]
    for name in ("heading_deg", "measure_m", "offset_m"):
        if name in numbers:
            own[name] = _optional(numbers[name], rows)
    for name in ("horizontal_rmse_m", "vertical_rmse_m"):
        if name in numbers:
            own[name] = [value or same[name] for value in _optional(numbers[name], rows)]
    return Columns(len(rows), same, {}).but(**own)


def _originals(survey: PlacedSurvey, rows: Rows, declaration: ImportDeclaration, sha256: str) -> JsonTexts:
    """The rows exactly as they were given, and the survey they belong to."""
    table = survey.table
    names = ("easting", "northing") if table.projected else ("lon_deg", "lat_deg")
    if table.projected and table.unit == "m":
        names = ("easting_m", "northing_m")
    same = _known(
        unit=table.unit if table.projected and table.unit != "m" else None,
        crs=table.crs,
        realization=declaration.realization,
        epoch=declaration.epoch,
        vertical_datum=declaration.vertical_datum,
    )
    of_survey = {**_known(**declaration.survey), "file_sha256": sha256, "format": table.format}
    own: dict[str, Sequence[Any]] = {
        names[0]: table.first[rows].tolist(),
        names[1]: table.second[rows].tolist(),
        "survey": json_objects(Columns(len(rows), of_survey, {"row": (rows + 1).tolist()})),
    }
    if table.height is not None:
        heights = _optional(table.height, rows)
        if table.height_unit == "m":
            own["height_m"] = heights
        else:
            own["height"] = heights
            own["height_unit"] = [None if height is None else table.height_unit for height in heights]
    for name in ("point", "description"):
        if name in table.texts:
            own[name] = [text or None for text in _texts_of(survey, rows, name)]
    return json_objects(
        Columns(len(rows), same, own), optional=("height_m", "height", "height_unit", "point", "description")
    )


def _known(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _texts_of(survey: PlacedSurvey, rows: Rows, name: str) -> list[str]:
    texts = survey.table.texts[name]
    return [texts[row] for row in rows.tolist()]


def _optional(values: Floats, rows: Rows) -> list[float | None]:
    """Values of rows, None where there is none."""
    chosen = values[rows]
    if np.isfinite(chosen).all():
        return chosen.tolist()  # type: ignore[no-any-return]
    return [value if np.isfinite(value) else None for value in chosen.tolist()]

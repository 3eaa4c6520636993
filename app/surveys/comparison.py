"""As-built surveys against the plan: the marker that each row measured, its residual, and what is there twice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NotRequired

import numpy as np
import numpy.typing as npt
import scipy
from typing_extensions import TypedDict

from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.table import Fault, Severity, warn
from app.geodesy import move_to_epoch
from app.geodesy.frames import metres_per_radian
from app.surveys.consistency_checks import nearest_of
from app.surveys.georeference import GeoreferencedSurvey, east_north_m
from app.surveys.location_checks import measured_changes
from app.values import Floats

REACH_M = 30.0
"""Longest residual of a row that is matched to its nearest marker; a longer one of a named marker is refused if it is
also 20 times the usual. [m] Checked by `python -m benchmarks.imports`."""
_SHIFT_ROWS = 4  # rows from which on a common shift is reported


class ComparisonFigures(TypedDict):
    """How far a survey is from the registry; a survey that matches no marker has no residuals."""

    matched: int
    tolerance_m: float
    beyond_tolerance: NotRequired[int]
    median_m: NotRequired[float]
    max_m: NotRequired[float]
    rmse_m: NotRequired[float]
    shift_east_m: NotRequired[float]
    shift_north_m: NotRequired[float]
    shift_up_m: NotRequired[float | None]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Rows of a survey beside the registered markers that they measured."""

    matched: npt.NDArray[np.intp]  # shape (N,): index of the marker of each row; -1 without one
    # `east_m`, `north_m`, `up_m`: shape (N,): [m] surveyed minus registered; NaN where unknown
    east_m: Floats
    north_m: Floats
    up_m: Floats

    @property
    def horizontal_m(self) -> Floats:
        """Length of the residuals. [m]"""
        return np.hypot(self.east_m, self.north_m)

    def document(self, tolerance_m: float) -> ComparisonFigures:
        """Figures of the comparison."""
        known = self.horizontal_m[np.isfinite(self.horizontal_m)]
        if not len(known):
            return {"matched": 0, "tolerance_m": tolerance_m}
        up = self.up_m[np.isfinite(self.up_m)]
        return {
            "matched": len(known),
            "tolerance_m": tolerance_m,
            "beyond_tolerance": int((known > tolerance_m).sum()),
            "median_m": round(float(np.median(known)), 4),
            "max_m": round(float(known.max()), 4),
            "rmse_m": round(float(np.sqrt(np.mean(known**2))), 4),
            "shift_east_m": round(float(np.nanmedian(self.east_m)), 4),
            "shift_north_m": round(float(np.nanmedian(self.north_m)), 4),
            "shift_up_m": round(float(np.median(up)), 4) if len(up) else None,
        }


def compare_survey(
    survey: GeoreferencedSurvey,
    lon_deg: Floats,
    lat_deg: Floats,
    height_m: Floats,
    matched: npt.NDArray[np.intp] | None,
    epoch: Floats | None = None,
) -> Comparison:
    """Residuals of a survey at registered markers, shape (M,): those that its rows name, or else the mutual nearest.

    Markers are compared where they were at the epoch of the survey, if their own epoch [decimal year] is known.
    """
    if epoch is not None and survey.placed.epoch is not None:
        moved = move_to_epoch(
            lon_deg, lat_deg, np.where(np.isfinite(epoch), epoch, survey.placed.epoch), survey.placed.epoch
        )
        lon_deg, lat_deg = moved.lon_deg, moved.lat_deg
    placed = survey.placed
    if matched is None:
        others = np.column_stack(east_north_m(lon_deg, lat_deg, survey.origin_deg)).reshape(-1, 2)
        matched = _nearest_once(np.column_stack([survey.east_m, survey.north_m]), others)
    known = matched >= 0
    east, north, up = (np.full(len(matched), np.nan) for _ in range(3))
    # on the ellipsoid: on a sphere residuals would be up to 0.5 % too short or too long
    across_deg = (placed.lon_deg[known] - lon_deg[matched[known]] + 180.0) % 360.0 - 180.0
    east_m, north_m = metres_per_radian(np.radians(lat_deg[matched[known]]))
    east[known] = np.radians(across_deg) * east_m
    north[known] = np.radians(placed.lat_deg[known] - lat_deg[matched[known]]) * north_m
    up[known] = survey.height_m[known] - height_m[matched[known]]
    return Comparison(matched, east, north, up)


def _nearest_once(points: Floats, others: Floats) -> npt.NDArray[np.intp]:
    """Mutual nearest pairs within reach."""
    matched = np.full(len(points), -1, dtype=np.intp)
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    if not len(others) or not len(rows):
        return matched
    distance, forth = scipy.spatial.cKDTree(others).query(points[rows], k=1)
    back = np.asarray(scipy.spatial.cKDTree(points[rows]).query(others, k=1)[1])
    mutual = (np.asarray(distance) <= REACH_M) & (back[np.asarray(forth)] == np.arange(len(rows)))
    matched[rows[mutual]] = np.asarray(forth)[mutual]
    return matched


def check_residuals(comparison: Comparison, tolerance_m: float, family: str) -> list[Fault]:
    """Faults that the residuals of a family's markers show: beyond the tolerance, no marker, one common shift."""
    faults = []
    residual = comparison.horizontal_m
    usual = float(np.nanmedian(residual)) if np.isfinite(residual).any() else 0.0
    for row in np.flatnonzero(comparison.matched < 0):
        message = f"no registered {family} belongs to the row"
        proposal = f"correct the code, import it without compare, or declare its family if it is no {family}"
        faults.append(Fault(int(row) + 1, "code", "no_marker", message, proposal))
    for row in np.flatnonzero(residual > tolerance_m):
        message = f"the marker was found {residual[row]:.3f} m from its registered place"
        far = residual[row] > max(REACH_M, 20 * usual)
        proposal = "check that the row belongs to this marker, its coordinates, and the declaration"
        faults.append(
            Fault(int(row) + 1, "position", "residual", message, proposal)
            if far
            else warn(int(row) + 1, "position", "residual", message, proposal)
        )
    return faults + _check_shift(comparison, tolerance_m) + _check_up(comparison)


def _check_shift(comparison: Comparison, tolerance_m: float) -> list[Fault]:
    known = np.isfinite(comparison.east_m)
    if known.sum() < _SHIFT_ROWS:
        return []
    east, north = np.median(comparison.east_m[known]), np.median(comparison.north_m[known])
    scatter = np.median(np.hypot(comparison.east_m[known] - east, comparison.north_m[known] - north))
    shift = float(np.hypot(east, north))
    if shift <= max(tolerance_m, 4 * float(scatter)):
        return []
    message = f"all rows are shifted alike by {east:+.3f} m east, {north:+.3f} m north"
    proposal = "check the CRS's datum, realization and epoch, and US survey against international feet"
    return [warn(None, "position", "systematic_shift", message, proposal)]


def _check_up(comparison: Comparison) -> list[Fault]:
    up = comparison.up_m[np.isfinite(comparison.up_m)]
    if len(up) < _SHIFT_ROWS or abs(float(np.median(up))) <= 0.5:
        return []
    message = f"the heights differ by {float(np.median(up)):+.2f} m from the registered ones"
    return [warn(None, "height", "height_shift", message, "check the unit and vertical_datum (geoid or ellipsoid)")]


# === Rows of a survey that are registered already: the same file once more, or the same points.


_SAME_M = 0.1  # [m] two markers of a family are never this near: plates are 0.3 m wide
_SAME_RMSE = 2.0  # [1] times the RMSE of the survey within which two measurements of a marker lie (95 %)
_NAMED_M = 0.5  # [m] greatest distance of rows with the same point number; also a bound for inaccurate surveys
_NEAREST = 4  # registered markers that a row is compared with; of other families may be as near
_CURE = 'declare compare: true if the survey measures registered markers, or duplicates: "store" to register it again'


@dataclass(frozen=True, slots=True)
class RegisteredPoints:
    """Registered markers around a survey, as they were surveyed."""

    # `lon_deg`, `lat_deg`: shape (M,)
    lon_deg: Floats
    lat_deg: Floats
    marker_ids: tuple[str, ...]
    families: tuple[str, ...]
    # `points`, `files`: point number in the survey, and SHA-256 of its file
    points: tuple[str | None, ...]
    files: tuple[str | None, ...]


def find_duplicates(
    survey: GeoreferencedSurvey, declaration: ImportDeclaration, file_sha256: str, known: RegisteredPoints
) -> Iterator[Fault]:
    """A fault for a file that was imported before, and one for each row whose marker is registered.

    A row is the same marker if one of its family is registered within the accuracy of the survey, or nearby from a row
    with the same point number. Nothing is reported of a comparison, or where duplicates are declared to be stored.
    """
    if declaration.compare or declaration.duplicates == "store" or not known.marker_ids:
        return
    again = known.files.count(file_sha256)
    if again:
        message = f"this file was imported before: {again} registered markers come from it"
        yield Fault(None, "content", "file_already_imported", message, _CURE)
        return
    rows = np.flatnonzero(survey.placed.placed)
    same = np.flatnonzero(np.array([family == declaration.family for family in known.families]))
    if not len(rows) or not len(same):
        return
    origin, changes = survey.origin_deg, measured_changes(survey)
    others = np.column_stack(east_north_m(known.lon_deg[same], known.lat_deg[same], origin))
    here = np.column_stack([survey.east_m[rows], survey.north_m[rows]])
    distance, index = nearest_of(here, others, min(_NEAREST, len(same)))
    rmse_m = _rmse_m(survey, declaration)[rows]
    points: Any = survey.table.texts.get("point")
    within = np.clip(_SAME_RMSE * np.nan_to_num(rmse_m), _SAME_M, _NAMED_M)
    for k in np.flatnonzero(distance[:, 0] <= _NAMED_M).tolist():
        name = points[int(rows[k])] if points is not None else ""
        for metres, other in zip(distance[k].tolist(), same[index[k]].tolist(), strict=True):
            if metres <= within[k] or (metres <= _NAMED_M and name and name == known.points[other]):
                marker = f"marker {known.marker_ids[other]}"
                shown = f" from point {known.points[other]}" if known.points[other] else ""
                message = f"{marker} is registered{shown}, {metres:.2f} m from this row"
                yield Fault(
                    int(rows[k]) + 1, "position", "already_registered", message, _CURE, Severity.REFUSED, changes
                )
                break


def _rmse_m(survey: GeoreferencedSurvey, declaration: ImportDeclaration) -> Floats:
    """Horizontal RMSE of each row; NaN where it is not declared. [m]"""
    whole = declaration.survey.horizontal_rmse_m
    of_all = np.full(survey.table.rows, np.nan if whole is None else float(whole))
    own = survey.table.numbers.get("horizontal_rmse_m")
    return of_all if own is None else np.where(np.isfinite(own), own, of_all)

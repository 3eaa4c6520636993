"""From recorded numbers to microtesla in vehicle axes, and whether the declared unit is plausible."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.formats.traces.declaration import UT_PER_UNIT, AxisConvention, FieldUnit, TraceDeclaration
from app.formats.traces.report import TraceReport
from app.sensors.magnetometer_bar import MAX_FIELD_UT

Field = npt.NDArray[np.float32]

EARTH_UT = (15.0, 75.0)
"""Plausible magnitudes of the field at calibrated sensors. [uT] Source: the earth's field at the surface is 22 to 67 uT
(World Magnetic Model); margin for the iron of a car by hand."""
_RAW_UT = (8.0, 2000.0)  # [uT] plausible median magnitudes at raw sensors; source: by hand, offsets of hundreds of uT
_AGREE = 0.2  # share by which the means of calibrated sensors differ at most; source: by hand
_CHECKED = 20_000  # samples by which the unit is checked; source: by hand, speed only
_BLOCK = 1 << 16  # samples that are converted at a time; bounds the memory
_VEHICLE_FROM = {AxisConvention.ISO8855: (1, 1, 1), AxisConvention.FLU: (1, 1, 1), AxisConvention.FRD: (1, -1, -1)}


def convert_field(
    field: Field, part: str, declaration: TraceDeclaration, metro: bool, report: TraceReport,
    known_unit: FieldUnit | None = None,
) -> Field:  # fmt: skip
    """Recorded values as microtesla in ISO 8855; what is damaged becomes NaN. Changes its input.

    Raises
    ------
    InvalidParameter
        Unit or axes are not declared where the format does not fix them, or the unit is implausible.
    """
    unit = declaration.unit or known_unit or (FieldUnit.MICROTESLA if metro else None)
    axes = declaration.axes or (AxisConvention.FRD if metro else None)
    if unit is None:
        raise InvalidParameter(
            f"the unit of the field in {part} is not declared",
            field="unit",
            limit=", ".join(u.value for u in FieldUnit),
            cure="declare it",
        )
    if axes is None and declaration.vehicle_from_sensor is None:
        raise InvalidParameter(
            f"the axes of the field in {part} are not declared",
            field="axes",
            limit=", ".join(a.value for a in AxisConvention),
            cure="declare them, or the rotation of each sensor",
        )
    scale = np.float32(UT_PER_UNIT[unit])
    offsets = np.float32(0) if declaration.offsets_ut is None else declaration.offsets_ut.astype(np.float32)
    some = field[:: max(len(field) // _CHECKED, 1)] * scale - offsets
    _check_unit(some, part, unit, declaration)
    turns = declaration.vehicle_from_sensor
    signs = np.array(_VEHICLE_FROM[axes] if axes else (1, 1, 1), np.float32)
    empty = wild = 0
    for at in range(0, len(field), _BLOCK):  # an hour's trace is not copied
        piece = field[at : at + _BLOCK]
        piece *= scale
        piece -= offsets
        missing = ~np.isfinite(piece).all(2)
        with np.errstate(invalid="ignore"):
            beyond = ~missing & ~(np.abs(piece) <= MAX_FIELD_UT).all(2)
        empty, wild = empty + int(missing.sum()), wild + int(beyond.sum())
        piece[missing | beyond] = np.nan
        piece[:] = piece * signs if turns is None else np.einsum("sij,tsj->tsi", turns.astype(np.float32), piece)
    report.leave_out(part, "values-missing", empty, "samples of a sensor, empty or not finite")
    report.leave_out(part, "values-damaged", wild, f"samples of a sensor beyond {MAX_FIELD_UT:g} uT")
    _warn_dead_sensors(field, part, report)
    return field


def _check_unit(field: Field, part: str, unit: FieldUnit, declaration: TraceDeclaration) -> None:
    """Refuse a unit in which the earth's field, which every magnetometer sees, would be impossible."""
    if declaration.background_removed:
        return
    some = field.astype(float)
    some[~np.isfinite(some)] = np.nan
    some = some[:, np.isfinite(some).any((0, 2))]
    some = some[np.isfinite(some).all((1, 2))]
    if not len(some):
        return
    means = np.median(some, axis=0)
    size = float(np.median(np.linalg.norm(means, axis=1)))
    middle = np.median(means, axis=0)
    apart = float(np.median(np.linalg.norm(means - middle, axis=1)))
    agree = declaration.calibrated or (len(means) >= 4 and apart < _AGREE * max(float(np.linalg.norm(middle)), 1e-12))
    low, high = EARTH_UT if agree else _RAW_UT
    if low <= size <= high:
        return
    fitting = [u.value for u in FieldUnit if u is not unit and low <= size * UT_PER_UNIT[u] / UT_PER_UNIT[unit] <= high]
    raise InvalidParameter(
        f"with {unit.value}, {part} has a field of {size:.4g} uT at a sensor"
        + (" after calibration" if declaration.calibrated else ", the same at all of them" if agree else ""),
        field="unit",
        limit=f"{low:g} to {high:g} uT: the earth's field" + ("" if agree else " and the sensors' offsets"),
        cure=f"the values look like {' or '.join(fitting)}: declare that unit"
        if fitting
        else "check the unit and the offsets, or declare that the background was removed",
    )


def _warn_dead_sensors(field: Field, part: str, report: TraceReport) -> None:
    some = field[:: max(len(field) // _CHECKED, 1)]
    for i in range(field.shape[1]):
        values = some[:, i]
        ok = np.isfinite(values).all(1)
        if not ok.any():
            report.warn(f"sensor {i + 1} of {part} has no values")
        elif ok.sum() > 10 and not np.ptp(values[ok], axis=0).any():
            report.warn(f"sensor {i + 1} of {part} always shows the same value")

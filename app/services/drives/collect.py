"""Results of decodes as the input of a track: fixes, speeds, headings, lane paths, and what is left out before."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Annotated

import numpy as np
from pydantic import Field

from app.errors import Conflict, InvalidParameter
from app.geodesy import LocalizationGrade
from app.inputs import Declaration, Identifier, Number, Text
from app.registry.decodes import DecodeRow, StoredResult
from app.services.decodes.context import DecodeKind
from app.tracks import Clock, DriveMarker, LanePath, LeftOutReason, PositionFix, Samples, TrackInput
from app.tracks.types import MAX_CLOCK_SIGMA_S

SPEED_SIGMA_M_S = 0.1
"""Noise of a vehicle's speed besides its scale. [m/s] A count of a wheel in 0.1 s is 5 cm."""
HEADING_SIGMA_DEG = 0.5
"""Noise of a vehicle's heading besides its bias. [deg]"""
DEFAULT_CLOCK_SIGMA_S = 0.5
"""Error of a clock that nothing is declared of. [s] A camera's clock set by NTP once a day."""
MIN_RECEIVER_M = 0.02
"""Least standard deviation of a receiver's position, both axes together. [m] RTK, with its antenna."""
_EPOCH_S = 1e9  # times beyond are seconds since 1970: no recording lasts 30 years
_IN_USE = ("active", "surveyed", "built")


class DriveDecode(Declaration):
    """A decode of a drive, and its sensor's clock."""

    id: Identifier
    clock: Annotated[Text, Field(min_length=1, max_length=80)] | None = Field(
        None, description="Name of the clock; decodes with the same name share one. Without it, each has its own."
    )
    offset_s: Number = Field(
        0.0, ge=-1e7, le=1e7, description="To be added to the times of the decode, where the clock was set wrong. [s]"
    )
    clock_sigma_s: Number = Field(
        DEFAULT_CLOCK_SIGMA_S,
        ge=0,
        le=MAX_CLOCK_SIGMA_S,
        description="How far the clock may be off; 0: it is exact, no offset is estimated. [s]",
    )


@dataclass(slots=True)
class Collected:
    """What decodes know of a drive."""

    clocks: dict[str, Clock] = field(default_factory=dict)
    fixes: list[PositionFix] = field(default_factory=list)
    speeds: list[Samples] = field(default_factory=list)
    headings: list[Samples] = field(default_factory=list)
    paths: list[LanePath] = field(default_factory=list)
    left_out: list[DriveMarker] = field(default_factory=list)
    on_lane: list[DriveMarker] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    positions: list[PositionFix] = field(default_factory=list)

    def track_input(self, survey_m2: Mapping[str, float]) -> TrackInput:
        """The input of the track, with the survey's variance of each marker. [m2]"""
        fixes = tuple(_with_survey(fix, survey_m2.get(fix.marker_id or "", 0.0)) for fix in self.fixes)
        fixes += tuple(self.positions)
        used = {fix.clock for fix in fixes} | {series.clock for series in (*self.speeds, *self.headings)}
        clocks = tuple(clock for name, clock in self.clocks.items() if name in used)
        return TrackInput(clocks, fixes, tuple(self.speeds), tuple(self.headings), tuple(self.paths))


def collect(rows: Sequence[tuple[DriveDecode, DecodeRow]], *, use_unfit: bool) -> Collected:
    """All that the results of finished decodes hold.

    Parameters
    ----------
    use_unfit : bool
        Use positions that are not for localization, too.

    Raises
    ------
    InvalidParameter
        A decode has no times, or the clocks contradict each other.
    Conflict
        A decode is not done.
    """
    found = Collected()
    for k, (declared, row) in enumerate(rows):
        where = f"decodes.{k}"
        if row.state != "done" or row.result is None:
            raise Conflict(
                f"decode {row.id} is {row.state}",
                field=where,
                limit="decodes that are done",
                cure="wait for it" if row.state in ("queued", "running") else "upload it again, or leave it out",
            )
        clock = Clock(declared.clock or declared.id, declared.offset_s, declared.clock_sigma_s)
        if found.clocks.setdefault(clock.name, clock) != clock:
            raise InvalidParameter(
                f"the clock {clock.name} is declared in two ways",
                field=f"{where}.offset_s",
                limit="one offset_s and clock_sigma_s for a clock",
                cure="give the clocks different names, or declare the same",
            )
        if row.kind == DecodeKind.TRACE:
            _add_trace(found, row, clock.name, where, use_unfit)
        elif row.kind == DecodeKind.PACKETS:
            _add_packets(found, row)
        else:
            _add_frames(found, row, clock.name, where, use_unfit)
        _add_positions(found, row, clock)
    return found


# --- kinds of decodes -------------------------------------------------------------------------------------------------


def _add_frames(found: Collected, row: DecodeRow, clock: str, where: str, use_unfit: bool) -> None:
    """Fixes of each marker in each frame."""
    assert row.result is not None
    captured = row.context.get("captured_at")
    frames = row.result.get("frames", ())
    alone = len(frames) == 1
    times = {frame["frame"]: _seconds(frame.get("captured_at") or (captured if alone else None)) for frame in frames}
    missing = 0
    for reading in row.result.get("readings", ()):
        match = reading.get("match")
        if match is None:
            continue
        place, fix = reading["frame"], reading.get("fix")
        reason, detail = _refused(match, fix, use_unfit)
        time_s = times.get(place)
        if reason is None and time_s is None:
            reason, detail, missing = LeftOutReason.NO_TIME, "the frame has no captured_at", missing + 1
        if reason is not None:
            family = reading.get("family", "")
            found.left_out.append(DriveMarker(match.get("marker_id"), family, row.id, place, False, reason, detail))
            continue
        assert time_s is not None
        found.fixes.append(_fix(clock, time_s, fix, match["marker_id"], reading["family"], row.id, place))
    if missing and not any(fix.decode_id == row.id for fix in found.fixes):
        raise _no_time(row, where, "captured_at of its frames", "send the time of each frame with the upload")


def _add_trace(found: Collected, row: DecodeRow, clock: str, where: str, use_unfit: bool) -> None:
    """Fixes at tags, speeds and headings."""
    assert row.result is not None
    motion = row.result.get("motion")
    if motion is None:
        raise InvalidParameter(
            f"decode {row.id} was made by an older version: it has no speeds",
            field=where,
            limit="traces decoded by this version",
            cure="upload the trace again, or reprocess it",
        )
    zero_s = _trace_zero_s(row, motion, where)
    count = max(len(motion["speed_m_s"]), len(motion["heading_deg"]))
    at = zero_s + motion["start_s"] + motion["step_s"] * np.arange(count)
    for name, series, sigma in (
        ("speed_m_s", found.speeds, SPEED_SIGMA_M_S),
        ("heading_deg", found.headings, HEADING_SIGMA_DEG),
    ):
        values = np.array([math.nan if value is None else value for value in motion[name]], float)
        if np.isfinite(values).any():
            series.append(Samples(clock, at[: values.size], values, sigma))
    for place, tag in enumerate(row.result.get("tags", ())):
        match, fix = tag.get("match"), tag.get("fix")
        if match is None:
            continue
        reason, detail = _refused(match, fix, use_unfit)
        if reason is not None:
            found.left_out.append(DriveMarker(match.get("marker_id"), "magnet", row.id, place, False, reason, detail))
            continue
        found.fixes.append(_fix(clock, zero_s + fix["t_s"], fix, match["marker_id"], "magnet", row.id, place))


def _fix(
    clock: str, time_s: float, fix: StoredResult, marker_id: str, family: str, decode_id: str, place: int
) -> PositionFix:
    cov = np.array(fix["covariance"], float)  # the heading is its last row
    return PositionFix(
        clock,
        time_s,
        fix["lon_deg"],
        fix["lat_deg"],
        (float(cov[0, 0]), float(cov[0, 1]), float(cov[1, 1])),
        fix["heading_deg"],
        math.degrees(math.sqrt(cov[-1, -1])),
        heading_cross_m_rad=(float(cov[0, -1]), float(cov[1, -1])),
        marker_id=marker_id,
        family=family,
        decode_id=decode_id,
        place=place,
    )


def _add_packets(found: Collected, row: DecodeRow) -> None:
    """The lane's path, which has no times and needs no clock."""
    assert row.result is not None
    lane = row.result.get("lane") or {}
    stations, sigma = lane.get("stations") or {}, lane.get("sigma_median_m")
    usable = lane.get("refusal") is None and lane.get("localization_grade") != LocalizationGrade.UNFIT
    if usable and sigma is not None:
        lon, lat = (np.array(stations[name], float) for name in ("lon_deg", "lat_deg"))
        found.paths.append(LanePath(row.id, lon, lat, float(sigma)))
    else:
        why = lane.get("refusal") or "; ".join(lane.get("localization_warnings", ())) or "it has no standard deviation"
        found.warnings.append(f"the path of decode {row.id} is not used: {why}")
    for place, marker in enumerate(row.result.get("markers", ())):
        why = marker.get("left_out") or (None if usable else "its path is not used")
        detail = why or "the vehicle did not drive along its path"
        entry = DriveMarker(
            marker.get("marker_id"),
            "cerpm",
            row.id,
            place,
            False,
            LeftOutReason.OFF_LANE,
            detail,
            number=marker["number"],
        )
        (found.left_out if why else found.on_lane).append(entry)


def _add_positions(found: Collected, row: DecodeRow, clock: Clock) -> None:
    """Positions of the vehicle's own receiver, which has a clock of its own beside that of the decode's sensor."""
    assert row.result is not None
    positions = row.result.get("receiver")
    if not positions:
        return
    own = replace(clock, name=f"{clock.name}, receiver")
    columns = zip(*(positions[name] for name in ("time_s", "lon_deg", "lat_deg", "accuracy_m")), strict=True)
    unknown = 0
    for place, (time_s, lon_deg, lat_deg, accuracy_m) in enumerate(columns):
        if not accuracy_m:
            unknown += 1
            continue
        axis_m2 = max(accuracy_m, MIN_RECEIVER_M) ** 2 / 2
        found.positions.append(
            PositionFix(
                own.name, time_s, lon_deg, lat_deg, (axis_m2, 0.0, axis_m2),
                common_m2=axis_m2, family="receiver", decode_id=row.id, place=place,
            )
        )  # fmt: skip
    if unknown:
        found.warnings.append(f"{unknown} positions of the receiver of decode {row.id} state no accuracy: not used")
    if unknown < len(positions["time_s"]):
        found.clocks.setdefault(own.name, own)


def _refused(match: StoredResult, fix: StoredResult | None, use_unfit: bool) -> tuple[LeftOutReason | None, str]:
    """Why a matched marker gives no fix."""
    if not match.get("registered"):
        return LeftOutReason.NOT_REGISTERED, match.get("note") or "no such marker is registered nearby"
    if match.get("plausible") is False:
        return LeftOutReason.IMPLAUSIBLE, match.get("note") or "too far from the approximate position"
    if match.get("ambiguous"):
        return LeftOutReason.AMBIGUOUS, match.get("note") or "several registered markers fit"
    if fix is None:
        return LeftOutReason.NO_FIX, match.get("note") or "its pose or its heading is not known"
    if fix["localization_grade"] == LocalizationGrade.UNFIT and not use_unfit:
        if match.get("status") not in _IN_USE:
            return LeftOutReason.SUSPECT, f"the marker is {match.get('status')}"
        return LeftOutReason.NO_GRADE, "; ".join(fix.get("notes", ())) or "its position is not for localization"
    return None, ""


# --- times ------------------------------------------------------------------------------------------------------------


def _seconds(stamp: str | None) -> float | None:
    return datetime.fromisoformat(stamp).timestamp() if stamp is not None else None


def _trace_zero_s(row: DecodeRow, motion: StoredResult, where: str) -> float:
    """What is to be added to times of a trace: they begin at captured_at, unless they are seconds since 1970."""
    if motion["start_s"] > _EPOCH_S:
        return 0.0
    captured = _seconds(row.context.get("captured_at"))
    if captured is None:
        raise _no_time(row, where, "captured_at of its context", "send captured_at, the time when the trace began")
    return captured - float(motion["start_s"])


def _no_time(row: DecodeRow, where: str, what: str, cure: str) -> InvalidParameter:
    return InvalidParameter(
        f"decode {row.id} has no time: {what} is missing", field=f"{where}.captured_at", limit="RFC 3339", cure=cure
    )


def _with_survey(fix: PositionFix, variance_m2: float) -> PositionFix:
    if not variance_m2 or fix.marker_id is None:
        return fix
    return replace(fix, common_m2=variance_m2)

"""The METRO paper's own pipeline (``method="metro"``): the peer in our tables, on a whole trace."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from app.decoders.magnet import metro_steps as steps
from app.decoders.magnet.readings import Finding, LineCrossing, MagnetReading, Side, TagReading
from app.markers.magnet import LineTag, Orientation, Polarity
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace

Floats = npt.NDArray[np.float64]

VERSION = "metro-1"
_SPIKE_UT = 100.0  # [uT] a sample so far off the median of three is a fault; source: by hand
_WHEEL_REACH_M = 0.2  # [m] across, from a reference sensor to those in front of its wheel; source: by hand
_MERGE_M = 0.125 * 10 / 3.6  # [m] detections nearer than this are one magnet, 0.125 s at 10 km/h; source: by hand
# Extrema of a dipole's field over mu0 m / (4 pi z^3): forward, 1 in x and 0.86 in z; upright, 2 in z and 0.86 in x.
# The weight is the middle of 1.16 and 0.43. Source: calculation; METRO section 5.2.2 has no rule
_AXIS_WEIGHT = {Orientation.FORWARD: 2**0.5, Orientation.UP: 1.0}
_CONFIDENCE = 0.5  # of every reading; source: by hand, the paper gives none


@dataclass(frozen=True, slots=True)
class MetroSettings:
    """Thresholds of the pipeline.

    Attributes
    ----------
    amplitude_ut : float
        Smallest step of an extremum. [uT] Source: METRO's published code; a phi = 0 magnet gives less at 30 cm.
    cancel_wheels : bool
        Adaptive magnetic field neutralization (section 5.3) on the array sensors nearest to a reference.
    tag_magnets : int
        Magnets that make a tag.
    tag_gap_m : float
        A longer gap ends a tag. [m]
    """

    amplitude_ut: float = 16.0
    cancel_wheels: bool = True
    tag_magnets: int = 3
    tag_gap_m: float = 5.0
    only: Orientation | None = None


def decode_trace_metro(
    trace: MagnetTrace, bar: MagnetometerBar, settings: MetroSettings | None = None
) -> list[Finding]:
    """Magnets, line crossings and tags as the paper finds them.

    Parameters
    ----------
    trace : MagnetTrace
        Whole; it must begin without a magnet for some 50 zero crossings of the noise.
    bar : MagnetometerBar
    settings : MetroSettings, optional
    """
    settings = settings or MetroSettings()
    if len(trace.t_s) < 60 or not trace.speed_t_s.size:
        return []
    speed = np.interp(trace.t_s, trace.speed_t_s, trace.speed_m_s)
    heading = None
    if trace.heading_t_s is not None and trace.heading_deg is not None and trace.heading_t_s.size:
        heading = np.interp(trace.t_s, trace.heading_t_s, np.degrees(np.unwrap(np.radians(trace.heading_deg))))
    odometer = np.concatenate(([0.0], np.cumsum(np.diff(trace.t_s) * (speed[1:] + speed[:-1]) / 2)))
    field = _filled(trace.field_ut.astype(float))
    if settings.cancel_wheels:
        field = _cancel(field, bar, trace.rate_hz)
    smooth = steps.smooth_speed_aware(field[:, bar.array][:, :, (0, 2)], speed)
    derivative = steps.derive_savitzky_golay(smooth, trace.rate_hz)
    found = []
    for j, sensor in enumerate(bar.array):
        lateral_cm = 100 * float(bar.positions_m[sensor, 1])
        for axis, orientation in enumerate((Orientation.FORWARD, Orientation.UP)):
            if settings.only not in (None, orientation):
                continue
            at, slope = steps.find_zero_crossings(derivative[:, j, axis])
            limit = steps.slope_threshold(slope)
            amplitude = steps.amplitude_steps(smooth[:, j, axis], at, trace.rate_hz)
            for k in np.flatnonzero((np.abs(slope) > limit) & (amplitude >= settings.amplitude_ut)):
                peak = slope[k] < 0
                # straight above a forward magnet the field points backward
                polarity = Polarity.N if peak == (orientation is Orientation.UP) else Polarity.S
                i = int(at[k])
                reading = MagnetReading(
                    float(trace.t_s[i]), float(odometer[i]), lateral_cm, polarity, orientation, _CONFIDENCE
                )
                found.append((float(amplitude[k]) * _AXIS_WEIGHT[orientation], reading))
    magnets = steps.merge_detections(found, _MERGE_M)
    return [*magnets, *_lines(magnets), *_tags(magnets, trace.t_s, speed, heading, settings)]


def _filled(field: Floats) -> Floats:
    """NaN replaced by the sample before; single samples far off by the median of three: faults of the readout."""
    bad = ~np.isfinite(field)
    if bad.any():
        at = np.maximum.accumulate(np.where(~bad, np.arange(len(field))[:, None, None], 0), axis=0)
        field = np.nan_to_num(np.take_along_axis(field, at, axis=0))
    middle = np.median(np.stack([field[:-2], field[1:-1], field[2:]]), axis=0)
    far = np.linalg.norm(field[1:-1] - middle, axis=2) > _SPIKE_UT
    field[1:-1][far] = middle[far]
    return field


def _cancel(field: Floats, bar: MagnetometerBar, rate_hz: float) -> Floats:
    """Wheel noise out of the sensors in front of each wheel: those within 20 cm across of a reference."""
    out = field.copy()
    quiet = min(int(rate_hz), len(field))
    for reference in bar.references:
        aligned = field[:, reference]  # traces come in the vehicle's axes already
        away = np.abs(bar.positions_m[bar.array, 1] - bar.positions_m[reference, 1])
        for sensor in bar.array[away < _WHEEL_REACH_M]:
            for axis in range(3):
                scaled = steps.scale_reference(aligned[:, axis], field[:, sensor, axis], quiet)
                out[:, sensor, axis] = steps.cancel_wheel_noise(field[:, sensor, axis], scaled)
    return out


def _lines(magnets: list[MagnetReading]) -> list[LineCrossing]:
    return [
        LineCrossing(
            m.t_s, m.odometer_m, LineTag(m.polarity).style, Side.LEFT if m.lateral_cm >= 0 else Side.RIGHT,
            m.lateral_cm, m.confidence,
        )
        for m in magnets
        if m.orientation is Orientation.UP
    ]  # fmt: skip


def _tags(
    magnets: list[MagnetReading], t_s: Floats, speed: Floats, heading: Floats | None, settings: MetroSettings
) -> list[TagReading]:
    """Every so many forward magnets make a tag, from the first on."""
    out = []
    row: list[MagnetReading] = []
    for magnet in (m for m in magnets if m.orientation is Orientation.FORWARD):
        if row and magnet.odometer_m - row[-1].odometer_m > settings.tag_gap_m:
            row = []
        row.append(magnet)
        if len(row) == settings.tag_magnets:
            out.append(_tag(row, t_s, speed, heading))
            row = []
    return out


def _tag(row: list[MagnetReading], t_s: Floats, speed: Floats, heading: Floats | None) -> TagReading:
    at = [int(np.searchsorted(t_s, m.t_s)) for m in row]
    start = float(heading[at[0]]) if heading is not None else 0.0
    gaps = tuple(max(steps.segment_distance_m(t_s, speed, heading, a, b, start), 1e-6) for a, b in pairwise(at))
    ratios = tuple(g / gaps[0] for g in gaps[1:])
    return TagReading(
        start_s=row[0].t_s,
        end_s=row[-1].t_s,
        polarities=tuple(m.polarity for m in row),
        gaps_m=gaps,
        gap_std_m=(0.0,) * len(gaps),
        length_m=sum(gaps),
        ratios=ratios,
        ratio_std=(0.0,) * len(ratios),
        lateral_cm=float(np.mean([m.lateral_cm for m in row])),
        tag=None,
        wrong_way=False,
        missing=0,
        extra=0,
        confidence=_CONFIDENCE,
        magnets=tuple(row),
    )

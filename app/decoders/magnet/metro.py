"""The METRO paper's own pipeline (``method="metro"``): the peer in our tables, on a whole trace."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import scipy

from app.compiled import ieee_kernel
from app.decoders.magnet.readings import Finding, LineCrossing, MagnetReading, Side, TagReading
from app.markers.magnet import LineTag, Orientation, Polarity
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace
from app.values import Floats

# === The steps of the METRO paper's pipeline (section 5), one function each.


Indices = npt.NDArray[np.intp]

MPH = 0.44704
"""A mile per hour. [m/s] Source: international mile of 1609.344 m."""
SMOOTHING = ((20 * MPH, 15), (40 * MPH, 9), (np.inf, 5))
"""Samples of the Gaussian window below a speed [m/s]. Source: METRO section 5.2.1, step 1."""
SG_WINDOW, SG_ORDER = 5, 2
"""Samples and polynomial order of the Savitzky-Golay filter. Source: METRO section 5.2.1, step 2."""
LMS_TAPS, LMS_RATE, LMS_WINDOW = 4, 1e-6, 50
"""Taps, rate [1/uT2] and samples of a window of the adaptive filter. METRO section 5.3 has none."""
THRESHOLD_CROSSINGS, THRESHOLD_FACTOR = 50, 1.5
"""Crossings of the noise that set the slope threshold, and its factor. METRO section 5.2.1, step 3, has none."""


def gaussian_window(samples: int) -> Floats:
    """Weights of a Gaussian over so many samples: three standard deviations to each side."""
    at = np.arange(samples) - (samples - 1) / 2
    weights = np.exp(-0.5 * (at / (samples / 6)) ** 2)
    out: Floats = weights / weights.sum()
    return out


def smooth_speed_aware(x: Floats, speed_m_s: Floats) -> Floats:
    """Step 1: Gaussian smoothing of x (T, ...) over 15, 9 or 5 samples, by the speed (T,) of each sample."""
    out = np.empty_like(x)
    low = -np.inf
    for high, samples in SMOOTHING:
        here = (speed_m_s >= low) & (speed_m_s < high)
        if here.any():
            out[here] = scipy.ndimage.convolve1d(x, gaussian_window(samples), axis=0, mode="nearest")[here]
        low = high
    return out


def derive_savitzky_golay(x: Floats, rate_hz: float) -> Floats:
    """Step 2: first derivative of x (T, ...), Savitzky-Golay over 5 samples of order 2, smoothed over 5. [1/s]"""
    d = scipy.signal.savgol_filter(x, SG_WINDOW, SG_ORDER, deriv=1, delta=1 / rate_hz, axis=0, mode="nearest")
    out: Floats = scipy.ndimage.convolve1d(d, gaussian_window(5), axis=0, mode="nearest")
    return out


def find_zero_crossings(derivative: Floats) -> tuple[Indices, Floats]:
    """Step 3: samples after which a derivative (T,) changes sign, and its slope there (negative at a peak)."""
    sign = np.signbit(derivative)
    at = np.flatnonzero(sign[1:] != sign[:-1])
    return at, derivative[at + 1] - derivative[at]


def slope_threshold(slopes: Floats, *, first: int = THRESHOLD_CROSSINGS, factor: float = THRESHOLD_FACTOR) -> float:
    """Step 3: what noise alone does not exceed, from the first crossings, before any magnet."""
    return float(factor * np.max(np.abs(slopes[:first]), initial=0.0))


def amplitude_steps(x: Floats, crossings: Indices, rate_hz: float) -> Floats:
    """Step 3: how far x (T,) is at each crossing from what is usual there, its mean over a second."""
    usual = scipy.ndimage.uniform_filter1d(x, max(int(rate_hz), 3), mode="nearest")
    return np.asarray(np.abs(x - usual)[crossings])


def scale_reference(reference: Floats, front: Floats, quiet: int) -> Floats:
    """AMN step 2: reference (T,) with the offset and the spread of the front sensor (T,) in a quiet beginning."""
    r, f = reference[:quiet], front[:quiet]
    spread = float(r.std())
    scaled: Floats = (reference - r.mean()) * (f.std() / spread if spread > 0 else 0.0) + f.mean()
    return scaled


@ieee_kernel
def cancel_wheel_noise(
    front: Floats, reference: Floats, taps: int = LMS_TAPS, rate: float = LMS_RATE, window: int = LMS_WINDOW
) -> Floats:
    """AMN step 2: front (T,) less what an LMS filter of it predicts of the reference (T,).

    The desired signal is the reference, the input the front sensor (section 5.3, figure 8); weights are renewed over
    windows of samples. Offsets are removed by the mean of the window before.
    """
    out = front.copy()
    weights = np.zeros(taps)
    for start in range(0, front.size, window):
        stop = min(start + window, front.size)
        low = max(start - window, 0)
        mean_f, mean_r = front[low:stop].mean(), reference[low:stop].mean()
        for i in range(max(start, taps - 1), stop):
            predicted = 0.0
            for k in range(taps):
                predicted += weights[k] * (front[i - k] - mean_f)
            error = (reference[i] - mean_r) - predicted
            for k in range(taps):
                weights[k] += 2 * rate * error * (front[i - k] - mean_f)
            out[i] = front[i] - predicted
    return out


def segment_distance_m(
    t_s: Floats, speed_m_s: Floats, heading_deg: Floats | None, first: int, last: int, heading0_deg: float
) -> float:
    """Equation 1: distance from sample first to last along the heading at the tag's first magnet. [m]"""
    v = speed_m_s[first:last]
    if heading_deg is not None:
        v = v * np.cos(np.radians(heading_deg[first:last] - heading0_deg))
    return float(np.sum(v * np.diff(t_s[first : last + 1])))


def merge_detections(found: list[tuple[float, MagnetReading]], gap_m: float) -> list[MagnetReading]:
    """Detections (amplitude, reading) within a distance of each other are one magnet: the strongest."""
    out: list[MagnetReading] = []
    group: list[tuple[float, MagnetReading]] = []
    for amplitude, reading in sorted(found, key=lambda f: f[1].odometer_m):
        if group and reading.odometer_m - group[-1][1].odometer_m > gap_m:
            out.append(max(group, key=lambda g: g[0])[1])
            group = []
        group.append((amplitude, reading))
    if group:
        out.append(max(group, key=lambda g: g[0])[1])
    return out


# === The METRO paper's own pipeline (``method="metro"``).


VERSION = "metro-1"
_SPIKE_UT = 100.0  # [uT] a sample so far off the median of three is a fault
_WHEEL_REACH_M = 0.2  # [m] across, from a reference sensor to those in front of its wheel
_MERGE_M = 0.125 * 10 / 3.6  # [m] detections nearer than this are one magnet, 0.125 s at 10 km/h
# Extrema of a dipole's field over mu0 m / (4 pi z^3): forward, 1 in x and 0.86 in z; upright, 2 in z and 0.86 in x.
# The weight is the middle of 1.16 and 0.43. Source: calculation; METRO section 5.2.2 has no rule
_AXIS_WEIGHT = {Orientation.FORWARD: 2**0.5, Orientation.UP: 1.0}
_CONFIDENCE = 0.5  # of every reading; the paper gives none


@dataclass(frozen=True, slots=True)
class MetroSettings:
    """Thresholds of the pipeline."""

    # smallest step of an extremum. [uT] Source: METRO's published code; a phi = 0 magnet gives less at 30 cm.
    amplitude_ut: float = 16.0
    # Adaptive magnetic field neutralization (section 5.3) on the array sensors nearest to a reference
    cancel_wheels: bool = True
    tag_magnets: int = 3  # magnets that make a tag
    tag_gap_m: float = 5.0  # [m] a longer gap ends a tag
    only: Orientation | None = None


def decode_trace_metro(
    trace: MagnetTrace, bar: MagnetometerBar, settings: MetroSettings | None = None
) -> list[Finding]:
    """Magnets, line crossings and tags as the paper finds them.

    Parameters
    ----------
    trace : MagnetTrace
        Whole; it must begin without a magnet for some 50 zero crossings of the noise.
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
    smooth = smooth_speed_aware(field[:, bar.array][:, :, (0, 2)], speed)
    derivative = derive_savitzky_golay(smooth, trace.rate_hz)
    found = []
    for j, sensor in enumerate(bar.array):
        lateral_cm = 100 * float(bar.positions_m[sensor, 1])
        for axis, orientation in enumerate((Orientation.FORWARD, Orientation.UP)):
            if settings.only not in (None, orientation):
                continue
            at, slope = find_zero_crossings(derivative[:, j, axis])
            limit = slope_threshold(slope)
            amplitude = amplitude_steps(smooth[:, j, axis], at, trace.rate_hz)
            for k in np.flatnonzero((np.abs(slope) > limit) & (amplitude >= settings.amplitude_ut)):
                peak = slope[k] < 0
                # straight above a forward magnet the field points backward
                polarity = Polarity.N if peak == (orientation is Orientation.UP) else Polarity.S
                i = int(at[k])
                reading = MagnetReading(
                    float(trace.t_s[i]), float(odometer[i]), lateral_cm, polarity, orientation, _CONFIDENCE
                )
                found.append((float(amplitude[k]) * _AXIS_WEIGHT[orientation], reading))
    magnets = merge_detections(found, _MERGE_M)
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
                scaled = scale_reference(aligned[:, axis], field[:, sensor, axis], quiet)
                out[:, sensor, axis] = cancel_wheel_noise(field[:, sensor, axis], scaled)
    return out


def _lines(magnets: list[MagnetReading]) -> list[LineCrossing]:
    return [
        LineCrossing(
            m.t_s, m.odometer_m, LineTag(m.polarity).style, Side.LEFT if m.lateral_cm >= 0 else Side.RIGHT,
            m.lateral_cm, m.confidence,
        )
        for m in magnets
        if m.phi_deg is Orientation.UP
    ]  # fmt: skip


def _tags(
    magnets: list[MagnetReading], t_s: Floats, speed: Floats, heading: Floats | None, settings: MetroSettings
) -> list[TagReading]:
    """Every so many forward magnets make a tag, from the first on."""
    out = []
    row: list[MagnetReading] = []
    for magnet in (m for m in magnets if m.phi_deg is Orientation.FORWARD):
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
    gaps = tuple(max(segment_distance_m(t_s, speed, heading, a, b, start), 1e-6) for a, b in pairwise(at))
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

"""The steps of the METRO paper's pipeline (section 5), one function each."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy

from app.compiled import ieee_kernel
from app.decoders.magnet.readings import MagnetReading

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

MPH = 0.44704
"""A mile per hour. [m/s] Source: international mile of 1609.344 m."""
SMOOTHING = ((20 * MPH, 15), (40 * MPH, 9), (np.inf, 5))
"""Samples of the Gaussian window below a speed [m/s]. Source: METRO section 5.2.1, step 1."""
SG_WINDOW, SG_ORDER = 5, 2
"""Samples and polynomial order of the Savitzky-Golay filter. Source: METRO section 5.2.1, step 2."""
LMS_TAPS, LMS_RATE, LMS_WINDOW = 4, 1e-6, 50
"""Taps, rate [1/uT2] and samples of a window of the adaptive filter. Source: chosen by hand; METRO section 5.3 has
none."""
THRESHOLD_CROSSINGS, THRESHOLD_FACTOR = 50, 1.5
"""Crossings of the noise that set the slope threshold, and its factor. Source: chosen by hand; METRO section 5.2.1,
step 3, has none."""


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

"""The mounting of a bar as its recording shows it: order, axes, gains and rotation of the sensors.

Whatever lies in the road, magnet or iron, its static field has a potential whose sources are below the bar. A potential
of random sources at a depth h is a sum of plane waves over the bar, and each of them fixes how the three axes of all
sensors go together::

    phi = exp(i (kx x + ky y)) exp(-|k| (h + z)),   |phi|2 = exp(-2 |k| h),   B = -grad phi

This is the field of a plane of independent dipoles. Along the road, the spectra of the sensors at each kx are therefore
Gaussian with a covariance that follows from their places and axes alone, and noise of each channel (Whittle's
likelihood). Mountings are compared by it. No magnet has to be found for that, and iron is as good as a magnet.

From below, four mountings look alike: a mounting, all signs inverted (magnets of the other polarity), left and right
exchanged with y inverted (a mirrored road), and both. The earth's field while the vehicle turns, with its headings,
shows which.

Shapes: W windows, F wave numbers along the road, S sensors, A array sensors.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace
from app.values import Bools, Floats

Complex = npt.NDArray[np.complex128]

WINDOW_M = 3.2
"""Length of road of a spectrum. [m] Over seven heights of METRO's clearance; a Hann window halves it."""
WAVES = 2 * np.pi * np.array([2, 3, 4, 5, 6, 8, 10, 12, 14]) / WINDOW_M
"""Wave numbers along the road. [rad/m] Waves of 1.6 m to 23 cm: longer ones come from cars beside the lane as well."""
PERIOD_M = 6.0
"""Period of the plane waves across the road. [m] Bar and sources beside it, so that they do not meet themselves."""
HEIGHTS_M = np.array([0.11, 0.15, 0.20, 0.27, 0.36, 0.48])
"""Depths of sources, a factor of 1.35 apart; each window has its own. [m] Clearances of 10 to 60 cm."""
STRENGTHS = 4.0 ** np.arange(10)
"""Energies of a window's sources, over the noise."""
UNEVEN, STAMP_S = 0.06, 0.0005
"""Errors of a channel that the model allows: share of its field (gain 2 %, direction 1.5 degrees, bounce), and time at
which its axis is converted. [1, s]"""
OTHER_SOURCES = 0.03
"""Share of windows whose field does not come from below alone: each channel is then independent of all others."""
DEGREES_OF_FREEDOM = 0.65
"""Share of the log likelihood that counts: neighbouring wave numbers of a Hann window share their data."""
MAX_WINDOWS, QUIET_WINDOWS, MIN_WINDOWS = 60, 40, 4
"""Windows with most energy that are compared, windows by which the noise is estimated, fewest that show anything."""
QUIET_SHARE = 0.6
"""Share of the windows for the noise, those with least energy, in which noise that sensors share is looked for."""
MIN_SAMPLES = 24
"""Samples of a window."""
SURE = 40.0
"""Log likelihood by which another mounting must be better; with `MIN_SUPPORT` windows that gain at least 1 each."""
MIN_SUPPORT = 3
DEAD_LEVEL, DEAD_ENERGY, SEEN_ENERGY = 2.0, 1.3, 4.0
"""Noise of a dead sensor over that of the others, its energy in windows over its noise, at most, and that of its
neighbours, at least."""
SUSPECT = 15.0
"""Log likelihood, each window's bounded, from which on a change is tried and must gain."""
MAX_CHANGED, MIN_EXPLAINED = 2, 0.8
"""Sensors that are corrected one by one, at most, and share of windows that a correction explains, at least."""
MIN_STRUCTURED = 0.97
"""Share of windows whose field comes from below, as declared, below which other mountings are tried."""
TRIED, STARTS = 4, 2
"""Changes of sensors that are evaluated in each round, by either of two orders; other orders or axes from which the
search of sensors starts."""
YAW_STEP_DEG = 5.0
RATE_HZ, MIN_HEADINGS_DEG = 5.0, 60.0
"""[Hz, deg] rate at which the earth's field is compared with the headings, and change of heading that it needs."""
MAX_RESIDUAL = 0.5
"""[amplitude] root mean square of what the turning field leaves, above which nothing is concluded."""
MAX_PHASE_DEG = 60.0
"""[deg] between the heading and the field's direction. Source: magnetic declination is below 30 degrees in inhabited
regions (World Magnetic Model), and iron adds some."""
MIRRORED = 2.0
"""[1] amplitude of the field that turns one way over that of the one that turns the other way."""
MAX_OF_WINDOW = 10.0
"""Log likelihood that one window adds at most to what asks for a closer look at a sensor."""
MIN_TURN_DEG, MAX_TURN_DEG = 5.0, 25.0
"""Smallest and largest rotation of the bar that is corrected. [deg]"""
SPIKE_UT = 20.0
"""Deviation of one sensor from the samples before and after that is a fault, if fewer than three sensors have it."""


# === What is compared.


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """How the channels of a recording belong to the sensors of the declared bar."""

    channels: npt.NDArray[np.intp]  # shape (S,): channel of each sensor
    axes: Floats  # shape (S, 3, 3): signed permutation from a channel to the axes of its sensor
    gains: Floats  # shape (S,): of the channel, 0 where it shows nothing
    rotation: Floats  # shape (3, 3): of the bar against the declared one

    @classmethod
    def declared(cls, sensors: int) -> Mounting:
        """That of the declaration."""
        return cls(np.arange(sensors), np.tile(np.eye(3), (sensors, 1, 1)), np.ones(sensors), np.eye(3))


@dataclass(frozen=True, slots=True, eq=False)
class Spectra:
    """Spectra of windows of a recording, times the root of the speed, so that a chip's noise is the same in all."""

    field: Complex  # shape (W, F, S, 3)
    crab_rad: Floats  # shape (W,): from the vehicle's heading to the direction in which the bar moves, to the left
    noise: Floats  # shape (F, S, 3): mean square
    quiet: Complex  # shape (Q, F, S, 3): the windows with least energy of those spread over the recording
    quiet_crab_rad: Floats  # shape (Q,)
    speed_m_s: float  # median


def measure_spectra(trace: MagnetTrace, bar: MagnetometerBar, events_m: Sequence[float]) -> Spectra | None:
    """Spectra of the windows with most energy: about events, and spread over the recording; None if there are few."""
    odometer = _odometer(trace)
    spread = np.arange(WINDOW_M / 2, odometer[-1] - WINDOW_M / 2, WINDOW_M / 2)
    centres = [c for k, c in enumerate(events_m) if not k or c - events_m[k - 1] > WINDOW_M / 3]
    events, quiet = _thinned(np.array(centres), MAX_WINDOWS * 3 // 2), _thinned(spread, QUIET_WINDOWS)
    if len(events) < MAX_WINDOWS // 2:
        events = np.union1d(events, _thinned(spread, 2 * MAX_WINDOWS))
    yaw = None if trace.heading_deg is None else np.unwrap(np.radians(-trace.heading_deg))
    forward_m = float(np.mean(bar.positions_m[bar.array, 0]))
    found, crab, speeds, is_quiet = [], [], [], []
    for number, centre in enumerate((*events, *quiet)):
        low, high = np.searchsorted(odometer, (centre - WINDOW_M / 2, centre + WINDOW_M / 2))
        if high - low < MIN_SAMPLES:
            continue
        s, t = odometer[low:high] - centre, trace.t_s[low:high]
        length_m, turned = max(float(s[-1] - s[0]), 0.1), 0.0
        if yaw is not None and trace.heading_t_s is not None:
            turned = float(np.diff(np.interp((t[0], t[-1]), trace.heading_t_s, yaw))[0])
        found.append(_spectrum(s, _repaired(trace.field_ut[low:high].astype(float))))
        speeds.append(length_m / float(t[-1] - t[0]))
        crab.append(math.atan(forward_m * turned / length_m))
        is_quiet.append(number >= len(events))
    for_noise, compared = np.array(is_quiet, bool), ~np.array(is_quiet, bool)
    if min(for_noise.sum(), compared.sum()) < MIN_WINDOWS:
        return None
    field = np.array(found) * np.sqrt(np.array(speeds))[:, None, None, None]
    # a quarter of the windows has less than this share of the mean of an exponential distribution
    noise = np.quantile(np.abs(field[for_noise]) ** 2, 0.25, axis=0) / -math.log(0.75)
    noise = np.maximum(noise, np.median(noise[:, bar.array], axis=1, keepdims=True) / 4)
    turns = np.array(crab)
    energy = np.median((np.abs(field[:, :, bar.array]) ** 2 / noise[:, bar.array]).mean(axis=1), axis=(1, 2))
    by_energy = np.argsort(energy)
    strongest, weakest = by_energy[compared[by_energy]][::-1], by_energy[for_noise[by_energy]]
    strongest, weakest = strongest[:MAX_WINDOWS], weakest[: round(QUIET_SHARE * len(weakest))]
    return Spectra(field[strongest], turns[strongest], noise, field[weakest], turns[weakest], float(np.median(speeds)))


def _odometer(trace: MagnetTrace) -> Floats:
    """Distance driven at each sample. [m]"""
    speed = np.abs(np.interp(trace.t_s, trace.speed_t_s, trace.speed_m_s))
    return np.concatenate([[0.0], np.cumsum(np.diff(trace.t_s) * (speed[1:] + speed[:-1]) / 2)])


def _thinned(values: Floats, most: int) -> Floats:
    """At most so many of them, evenly chosen."""
    return values if len(values) <= most else values[np.linspace(0, len(values) - 1, most).astype(int)]


def _repaired(field_ut: Floats) -> Floats:
    """Samples (N, S, 3) without spikes of single sensors and without gaps."""
    field = np.where(np.isfinite(field_ut), field_ut, np.nan_to_num(np.nanmedian(field_ut, axis=0)))
    middle = np.median(np.stack([field[:-2], field[1:-1], field[2:]]), axis=0)
    off = np.abs(field[1:-1] - middle).max(axis=2)
    alone = off > SPIKE_UT + np.sort(off, axis=1)[:, -3:-2]
    field[1:-1][alone] = middle[alone]
    return field


def _spectrum(s_m: Floats, field_ut: Floats) -> Complex:
    """Fourier transform of a window at unevenly spaced places, its mean and slope removed, shape (F, S, 3)."""
    flat = field_ut.reshape(len(s_m), -1)
    weight = (1 + np.cos(2 * np.pi * s_m / WINDOW_M)) * np.gradient(s_m)
    line = np.stack([np.ones_like(s_m), s_m], axis=1)
    weighted = line * weight[:, None]
    flat = flat - line @ np.linalg.lstsq(weighted.T @ line, weighted.T @ flat, rcond=None)[0]
    waves: Complex = np.exp(-1j * np.outer(WAVES, s_m)) * weight
    return np.asarray((waves @ flat).reshape(len(WAVES), *field_ut.shape[1:]))


# === The likelihood.


@dataclass(frozen=True, slots=True, eq=False)
class Likelihood:
    """Log likelihoods of the windows under a mounting, and what each sensor should have read by all others."""

    windows: Floats  # shape (W,)
    structured: Bools  # shape (W,): its field comes from below
    heights: npt.NDArray[np.intp]  # shape (W,): likeliest of `HEIGHTS_M`

    @property
    def total(self) -> float:
        """Of all windows."""
        return float(self.windows.sum())


class MountingModel:
    """The likelihood of mountings of a bar.

    Parameters
    ----------
    heights : sequence of int
        Indices of the `HEIGHTS_M` that are tried.
    """

    def __init__(self, spectra: Spectra, bar: MagnetometerBar, heights: Sequence[int] = range(len(HEIGHTS_M))) -> None:
        self.spectra, self.bar, self.heights = spectra, bar, tuple(heights)
        self.positions_m = bar.positions_m - bar.positions_m[bar.array].mean(axis=0)
        self._in_array = _is_array(bar)
        waves = np.arange(0.5, 60.0) * 2 * np.pi / PERIOD_M
        self._across = waves[waves < 40.0]
        self._level = math.sqrt(float(np.median(spectra.noise[:, bar.array])))

    def evaluate(self, mounting: Mounting) -> Likelihood:
        """Log likelihood of each window."""
        data, places = self._oriented(mounting, self.spectra.field, self.spectra.crab_rad)
        windows = len(data)
        shape = (len(self.heights), len(STRENGTHS), windows)
        below, apart = np.zeros(shape), np.zeros(shape)
        lost = 0.0
        for f, white in enumerate(self._whitening(mounting)):
            lost -= 2 * float(np.linalg.slogdet(white)[1])
            whitened = data[:, f].reshape(windows, -1) @ white.T
            squared = np.abs(whitened) ** 2
            for h, index in enumerate(self.heights):
                covariance = self._covariance(WAVES[f], HEIGHTS_M[index], places, mounting.gains, white)
                values, vectors = np.linalg.eigh(covariance)
                projected = np.abs(whitened @ vectors.conj()) ** 2
                for out, energies, parts in (
                    (below, np.maximum(values, 0.0), projected), (apart, np.diag(covariance).real, squared)
                ):  # fmt: skip
                    variance = 1 + STRENGTHS[:, None] * energies
                    out[h] -= np.log(variance).sum(axis=1)[:, None] + (1 / variance) @ parts.T
        flat = DEGREES_OF_FREEDOM * below.reshape(-1, windows)
        structured = np.logaddexp.reduce(flat, axis=0) + math.log(1 - OTHER_SOURCES)
        flat_apart = DEGREES_OF_FREEDOM * apart.reshape(-1, windows)
        unstructured = np.logaddexp.reduce(flat_apart, axis=0) + math.log(OTHER_SOURCES)
        best = np.argmax(flat, axis=0)
        # densities of data, not of data over noise, so that rotations of the bar compare
        total = np.logaddexp(structured, unstructured) - DEGREES_OF_FREEDOM * lost
        return Likelihood(total, structured > unstructured, best // len(STRENGTHS))

    def _whitening(self, mounting: Mounting) -> list[Complex]:
        """Matrices that make the noise of all channels white, one for each wave number.

        The noise is that of each channel, and what several share: that of a wheel. It stands out of the quiet windows'
        covariance by more than chance does (Marchenko and Pastur's edge).
        """
        noise = self._noise(mounting)
        quiet, _places = self._oriented(mounting, self.spectra.quiet, self.spectra.quiet_crab_rad)
        out = []
        for f in range(len(WAVES)):
            scale = 1 / np.sqrt(noise[f].ravel())
            seen = quiet[:, f].reshape(len(quiet), -1) * scale
            chance = (1 + math.sqrt(seen.shape[1] / max(len(seen), 1))) ** 2
            values, vectors = np.linalg.eigh(seen.T @ seen.conj() / max(len(seen), 1))
            shared = values > chance
            values, vectors = values[shared], vectors[:, shared]
            out.append((np.eye(len(scale)) + (vectors * (1 / np.sqrt(values) - 1)) @ vectors.conj().T) * scale)
        return out

    def _oriented(self, mounting: Mounting, field: Complex, crab_rad: Floats) -> tuple[Complex, Floats]:
        """Spectra (W, F, S, 3) along and across the direction of motion, as if all sensors were abreast, and places.

        The x axis is multiplied by i, which makes the covariance of a field from below real.
        """
        data = np.einsum("sab,wfsb->wfsa", mounting.axes, field[:, :, mounting.channels])
        turns = np.where(self._in_array[:, None, None], mounting.rotation, np.eye(3))
        places = np.einsum("sab,sb->sa", turns, self.positions_m)
        out = np.empty_like(data)
        for w, crab in enumerate(crab_rad):
            turn = rotation_about("z", -crab)
            ahead = places @ turn[0]
            out[w] = np.einsum("sab,fsb->fsa", turn @ turns, data[w]) * np.exp(-1j * np.outer(WAVES, ahead))[:, :, None]
        out[..., 0] *= 1j
        return out, places

    def _noise(self, mounting: Mounting) -> Floats:
        moved = np.einsum("sab,fsb->fsa", np.abs(mounting.axes), self.spectra.noise[:, mounting.channels])
        turned = np.einsum("ab,fsb->fsa", mounting.rotation**2, moved)
        return np.asarray(np.where(self._in_array[:, None], turned, moved))

    def _covariance(self, wave: float, height_m: float, places_m: Floats, gains: Floats, white: Complex) -> Complex:
        """Covariance of whitened channels from sources of strength 1 at a depth, shape (3 A, 3 A)."""
        across = self._across[self._across < max(5 / height_m, 12.0)]
        length = np.hypot(wave, across)
        cosine, sine = np.cos(np.outer(places_m[:, 1], across)), np.sin(np.outer(places_m[:, 1], across))
        decay = gains[:, None] * np.exp(-length * (height_m + places_m[:, 2, None]))
        x, y, z = wave * decay, across * decay, length * decay
        rows = [np.hstack(one) for one in ((x * cosine, x * sine), (y * sine, -y * cosine), (z * cosine, z * sine))]
        factor = np.stack(rows, axis=1).reshape(3 * len(places_m), -1)
        factor *= math.exp(WAVES[0] * height_m) / 10 * self._level
        own = UNEVEN**2 + (wave * STAMP_S * self.spectra.speed_m_s) ** 2
        covariance = factor @ factor.T
        covariance[np.diag_indices(len(covariance))] *= 1 + own
        return np.asarray(white @ covariance @ white.conj().T)

    def sensor_changes(self, mounting: Mounting) -> list[Mounting]:
        """Mountings in which one sensor's axes are inverted, or two sensors exchanged, that are worth to be evaluated.

        The noise is that of the mounting before, so their likelihoods are near the true ones only.
        """
        spectra, array = self.spectra, self.bar.array
        data, places = self._oriented(mounting, spectra.field, spectra.crab_rad)
        whitening = self._whitening(mounting)
        windows = len(data)
        signs = [np.diag(s) for s in itertools.product((1.0, -1.0), repeat=3)][1:]
        inverted = [replace(mounting, axes=np.einsum("ab,sbc->sac", turn, mounting.axes)) for turn in signs]
        flipped = [self._oriented(one, spectra.field, spectra.crab_rad)[0] for one in inverted]
        changes = [(k, k, number) for k in array for number in range(len(signs))]
        changes += [(k, other, -1) for k, other in itertools.combinations(array, 2)]
        totals = np.zeros((len(changes) + 1, len(self.heights), len(STRENGTHS), windows))
        for f, h in itertools.product(range(len(WAVES)), range(len(self.heights))):
            white = whitening[f]
            covariance = self._covariance(WAVES[f], HEIGHTS_M[self.heights[h]], places, mounting.gains, white)
            values, vectors = np.linalg.eigh(covariance)
            variance = 1 + STRENGTHS[:, None] * np.maximum(values, 0.0)
            lost = np.log(variance).sum(axis=1)[:, None]
            own = data[:, f]  # W, S, 3
            together = white.T @ vectors.conj()
            base = own.reshape(windows, -1) @ together
            parts = together.reshape(self.bar.sensor_count, 3, -1)
            totals[-1, h] -= lost + (1 / variance) @ (np.abs(base) ** 2).T
            for number, (k, other, sign) in enumerate(changes):
                if sign >= 0:
                    projected = base + (flipped[sign][:, f, k] - own[:, k]) @ parts[k]
                else:
                    projected = base + (own[:, other] - own[:, k]) @ (parts[k] - parts[other])
                totals[number, h] -= lost + (1 / variance) @ (np.abs(projected) ** 2).T
        flat = DEGREES_OF_FREEDOM * totals.reshape(len(totals), -1, windows)
        each = np.logaddexp.reduce(flat, axis=1)
        gained = each[:-1] - each[-1]
        bounded = np.clip(gained, -MAX_OF_WINDOW, MAX_OF_WINDOW).sum(axis=1)
        likely = np.argsort(-bounded)[:TRIED].tolist() + np.argsort(-gained.sum(axis=1))[:TRIED].tolist()
        worth = [n for n in dict.fromkeys(likely) if max(bounded[n], gained[n].sum() / 4) > SUSPECT]
        found = []
        for number in worth:
            k, other, sign = changes[number]
            axes, channels = mounting.axes.copy(), mounting.channels.copy()
            if sign >= 0:
                axes[k] = signs[sign] @ axes[k]
            else:
                channels[[k, other]], axes[[k, other]] = channels[[other, k]], axes[[other, k]]
            found.append(replace(mounting, axes=axes, channels=channels))
        return found


def rotation_about(axis: str, angle_rad: float) -> Floats:
    """Rotation matrix about x, y or z."""
    a, b = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    turn = np.eye(3)
    turn[a, a] = turn[b, b] = math.cos(angle_rad)
    turn[a, b], turn[b, a] = -math.sin(angle_rad), math.sin(angle_rad)
    return turn


# === The search.


@dataclass(frozen=True, slots=True)
class MountingFault:
    """A way in which a bar is not as it was declared."""

    field: str  # of the declaration
    name: str  # what is wrong, and with which sensors
    cure: str


@dataclass(frozen=True, slots=True, eq=False)
class MountingCheck:
    """What a recording shows of its bar's mounting."""

    mounting: Mounting | None  # that explains the recording; None where it cannot be decided
    faults: tuple[MountingFault, ...] = ()  # none where the bar is as declared


def as_declared(mounting: Mounting, trace: MagnetTrace, bar: MagnetometerBar) -> MagnetTrace:
    """The recording as the declared bar would have made it; NaN of dead sensors."""
    dead = mounting.gains == 0
    turns = np.where(_is_array(bar)[:, None, None], mounting.rotation @ mounting.axes, mounting.axes)
    field = np.einsum("sab,tsb->tsa", turns.astype(np.float32), trace.field_ut[:, mounting.channels])
    if not np.array_equal(mounting.rotation, np.eye(3)):
        places = bar.positions_m - bar.positions_m[bar.array].mean(axis=0)
        ahead = (places @ mounting.rotation.T - places)[:, 0]
        field, odometer = _repaired(field), _odometer(trace)
        odometer += 1e-9 * np.arange(len(odometer))  # also rises where the vehicle stands
        for j, axis in itertools.product(bar.array, range(3)):  # as if it were where it was declared
            field[:, j, axis] = np.interp(odometer - ahead[j], odometer, field[:, j, axis])
    field[:, dead] = np.nan
    return replace(trace, field_ut=field)


def check_mounting(trace: MagnetTrace, bar: MagnetometerBar, events_m: Sequence[float]) -> MountingCheck:
    """Compare the declared mounting with others, and choose the one that explains the recording.

    Parameters
    ----------
    events_m : sequence of float
        Odometer at which something was found, rising. [m]
    """
    declared = Mounting.declared(bar.sensor_count)
    spectra = measure_spectra(trace, bar, events_m)
    if spectra is None:
        return MountingCheck(declared)
    best, model = _search(spectra, bar, declared, trace)
    common = _common_axes(best, bar)
    signs = _signs_by_earth(turning_field(as_declared(best, trace, bar), bar))
    if not np.array_equal(common, np.eye(3)):
        if signs is None:
            return MountingCheck(None, (_undecided(common),))
        best, signs = _with_signs(best, signs, spectra, bar), None
    best = _turned(model, best, trace)
    faults = tuple(_describe(best, bar))
    is_likely = _changed_sensors(best, bar) <= MAX_CHANGED and signs in (None, (1.0, 1.0))
    if faults and not (is_likely and model.evaluate(best).structured.mean() >= MIN_EXPLAINED):
        name = f"the bar is not as declared, and no single cause explains it ({'; '.join(one.name for one in faults)})"
        return MountingCheck(None, (MountingFault("bar.sensors", name, "check the order and axes of all sensors"),))
    return MountingCheck(best, faults)


def _changed_sensors(mounting: Mounting, bar: MagnetometerBar) -> int:
    """Sensors of the array that differ from the likeliest fault of all."""
    turned = (mounting.axes != _common_axes(mounting, bar)).any(axis=(1, 2))
    orders = (np.arange(bar.sensor_count), _mirrored(bar), *_orders(bar).values())
    return min(int(((mounting.channels != order) | turned)[bar.array].sum()) for order in orders)


def _at_heights(spectra: Spectra, bar: MagnetometerBar, likelihood: Likelihood) -> MountingModel:
    """The model with the two likeliest heights only."""
    counts = np.bincount(likelihood.heights, minlength=len(HEIGHTS_M))
    return MountingModel(spectra, bar, sorted(np.argsort(-counts)[:2].tolist()))


def _search(
    spectra: Spectra, bar: MagnetometerBar, declared: Mounting, trace: MagnetTrace
) -> tuple[Mounting, MountingModel]:
    """The mounting with the highest likelihood: order and axes of all sensors first, then single sensors."""
    everywhere = MountingModel(spectra, bar)
    before = everywhere.evaluate(declared)
    near = _at_heights(spectra, bar, before)
    turned = _turned(near, declared, trace)
    best, _likelihood = _with_other_sensors(near, turned, near.evaluate(turned))
    if before.structured.mean() >= MIN_STRUCTURED and best is turned and not _yaw_deg(best):
        return best, near  # what changes sensors may be a fault of them all, also where most windows are quiet
    found = [(everywhere.evaluate(best), best)]
    better = []
    for candidate in (*_ordered(bar), *_with_other_axes(bar)):
        likelihood = everywhere.evaluate(candidate)
        if _is_better(likelihood, before):
            better.append((likelihood, candidate))
    for likelihood, candidate in sorted(better, key=lambda one: -one[0].total)[:STARTS]:
        model = _at_heights(spectra, bar, likelihood)
        best, _likelihood = _with_other_sensors(model, candidate, model.evaluate(candidate))
        found.append((everywhere.evaluate(best), best))
    likelihood, best = max(found, key=lambda one: one[0].total)
    return best, _at_heights(spectra, bar, likelihood)


def _with_other_sensors(model: MountingModel, best: Mounting, current: Likelihood) -> tuple[Mounting, Likelihood]:
    """A mounting in which single sensors are changed as long as the likelihood asks for it."""
    for sensor in _dead_sensors(model.spectra, model.bar):
        candidate = replace(best, gains=np.where(best.channels == sensor, 0.0, best.gains))
        if _is_better(found := model.evaluate(candidate), current):
            best, current = candidate, found
    for _ in range(model.bar.sensor_count):
        tried = [(one, model.evaluate(one)) for one in model.sensor_changes(best)]
        better = [(one, found) for one, found in tried if _is_better(found, current)]
        if not better:
            break
        best, current = max(better, key=lambda pair: pair[1].total)
    return best, current


def _is_better(found: Likelihood, before: Likelihood) -> bool:
    """Whether a mounting is better beyond doubt of a few windows."""
    gained = found.windows - before.windows
    bounded = float(np.clip(gained, -MAX_OF_WINDOW, MAX_OF_WINDOW).sum())
    return float(gained.sum()) > SURE and bounded > SUSPECT and int((gained > 1).sum()) >= MIN_SUPPORT


def _ordered(bar: MagnetometerBar) -> Iterator[Mounting]:
    """Mountings in which the sensors have another order."""
    for channels in _orders(bar).values():
        yield replace(Mounting.declared(bar.sensor_count), channels=channels)


def _with_other_axes(bar: MagnetometerBar) -> Iterator[Mounting]:
    """Mountings in which all sensors are turned in another way; one of those that look alike from below."""
    declared = Mounting.declared(bar.sensor_count)
    for order in itertools.permutations(range(3)):
        for signs in ((1.0, 1.0, 1.0), (-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, -1.0)):
            turn = np.diag(signs) @ np.eye(3)[list(order)]
            if not np.array_equal(turn, np.eye(3)):
                yield replace(declared, axes=np.tile(turn, (bar.sensor_count, 1, 1)))


def _orders(bar: MagnetometerBar) -> dict[str, npt.NDArray[np.intp]]:
    """Other orders of the sensors than the declared one, by name; channel of each sensor."""
    same = np.arange(bar.sensor_count)
    found = {"the order of all sensors is reversed": same[::-1].copy()}
    left, right = (bar.array[bar.positions_m[bar.array, 1] * side > 0] for side in (1, -1))
    for name, halves in (
        ("both halves are numbered from their other ends", (left, right)),
        ("the left half is numbered from its other end", (left,)),
        ("the right half is numbered from its other end", (right,)),
    ):
        channels = same.copy()
        for half in halves:
            by_place = half[np.argsort(bar.positions_m[half, 1])]
            channels[by_place] = by_place[::-1]
        found[name] = channels
    mirrored = _mirrored(bar)
    return {name: order for name, order in found.items() if not np.array_equal(order[bar.array], mirrored[bar.array])}


def _mirrored(bar: MagnetometerBar) -> npt.NDArray[np.intp]:
    """Channel of each sensor where left and right of the array are exchanged."""
    channels = np.arange(bar.sensor_count)
    by_place = bar.array[np.argsort(bar.positions_m[bar.array, 1])]
    channels[by_place] = by_place[::-1]
    return channels


def _is_array(bar: MagnetometerBar) -> Bools:
    chosen = np.zeros(bar.sensor_count, bool)
    chosen[bar.array] = True
    return chosen


def _dead_sensors(spectra: Spectra, bar: MagnetometerBar) -> list[int]:
    """Channels of the array that show no more where something is passed than elsewhere, though their neighbours do.

    They are no louder than others. Only neighbours count: what lies in the middle of the lane, the ends do not see.
    """
    level = np.median(spectra.noise, axis=(0, 2))
    energy = (np.abs(spectra.field) ** 2 / spectra.noise).mean(axis=(0, 1, 3))
    quiet = level < DEAD_LEVEL * np.median(level[bar.array])
    by_place = bar.array[np.argsort(bar.positions_m[bar.array, 1])]
    found = []
    for k, sensor in enumerate(by_place):
        beside = [by_place[n] for n in (k - 1, k + 1) if 0 <= n < len(by_place)]
        if quiet[sensor] and energy[sensor] < DEAD_ENERGY and min(energy[beside]) > SEEN_ENERGY:
            found.append(int(sensor))
    return found


def _turned(model: MountingModel, best: Mounting, trace: MagnetTrace) -> Mounting:
    """The mounting turned about the vertical, if its likelihood asks for that.

    In a bend, a bar ahead of the rear axle moves at an angle, which only headings show.
    """
    if trace.heading_deg is None:
        return best
    first_deg = angle_deg = _yaw_deg(best)
    straight = model.evaluate(_at_yaw(best, 0.0))
    current = model.evaluate(best) if first_deg else straight
    step_deg = YAW_STEP_DEG
    for _ in range(3):
        low, high = (model.evaluate(_at_yaw(best, angle_deg + side * step_deg)) for side in (-1, 1))
        bend = low.total + high.total - 2 * current.total
        move = (low.total - high.total) / (2 * bend) if bend < 0 else math.copysign(1.0, high.total - low.total)
        if abs(angle_deg + move * step_deg) < 1.0 and angle_deg == 0.0:
            return best
        angle_deg = float(np.clip(angle_deg + step_deg * np.clip(move, -2, 2), -MAX_TURN_DEG, MAX_TURN_DEG))
        current = model.evaluate(_at_yaw(best, angle_deg))
        step_deg /= 2
    ahead = np.abs(model.spectra.crab_rad) < math.radians(MIN_TURN_DEG / 2)  # a wrong speed makes bends look sharper
    is_turned = _is_better(
        replace(current, windows=current.windows[ahead]), replace(straight, windows=straight.windows[ahead])
    )
    return _at_yaw(best, angle_deg if abs(angle_deg) > MIN_TURN_DEG and is_turned else 0.0)


def _yaw_deg(mounting: Mounting) -> float:
    return math.degrees(math.atan2(mounting.rotation[1, 0], mounting.rotation[0, 0]))


def _at_yaw(mounting: Mounting, angle_deg: float) -> Mounting:
    return replace(mounting, rotation=rotation_about("z", math.radians(angle_deg)))


# === Which of the mountings that look alike from below it is.


def turning_field(trace: MagnetTrace, bar: MagnetometerBar) -> tuple[complex, complex] | None:
    """Amplitudes of the earth's horizontal field that turn with the heading and against it; None on a straight drive.

    With x forward, y left and the heading h clockwise from north, x + iy of the earth's field is H exp(i (h - D)) and
    constant offsets, where D is the declination. One more term, in exp(-ih), is left where an axis is mirrored. [uT]
    """
    if trace.heading_t_s is None or trace.heading_deg is None or not len(trace.heading_t_s):
        return None
    step = max(round(trace.rate_hz / RATE_HZ), 1)
    with np.errstate(all="ignore"):
        field: Floats = np.nanmedian(trace.field_ut[::step][:, bar.array], axis=1).astype(float)
    heading = np.interp(trace.t_s[::step], trace.heading_t_s, np.unwrap(np.radians(trace.heading_deg)))
    known = np.isfinite(field).all(axis=1)
    if known.sum() < 20 or np.ptp(heading[known]) < np.radians(MIN_HEADINGS_DEG):
        return None
    turning, seen = np.exp(1j * heading[known]), field[known, 0] + 1j * field[known, 1]
    shape = np.stack([turning, turning.conj(), np.ones_like(turning)], axis=1)
    fitted = np.linalg.lstsq(shape, seen, rcond=None)[0]
    along, against, _offset = (complex(one) for one in fitted)
    left = float(np.sqrt(np.mean(np.abs(seen - shape @ fitted) ** 2)))
    return None if left > MAX_RESIDUAL * max(abs(along), abs(against)) else (along, against)


def _signs_by_earth(turning: tuple[complex, complex] | None) -> tuple[float, float] | None:
    """Signs of x and y by which the earth's field turns as it must."""
    if turning is None:
        return None
    along, against = turning
    larger, smaller = (along, against) if abs(along) > abs(against) else (against, along)
    phase_deg = abs(math.degrees(np.angle(larger)))
    if abs(larger) < MIRRORED * abs(smaller) or min(phase_deg, 180 - phase_deg) > MAX_PHASE_DEG:
        return None
    sign_x = 1.0 if phase_deg < 90 else -1.0
    return sign_x, sign_x if larger is along else -sign_x


def _with_signs(mounting: Mounting, signs: tuple[float, float], spectra: Spectra, bar: MagnetometerBar) -> Mounting:
    """The mounting that looks like another one from below and has these signs of x and y."""
    x, y = signs
    turn = np.diag((x, y, x))
    axes = np.einsum("ab,sbc->sac", turn, mounting.axes)
    if x == y:
        return replace(mounting, axes=axes)
    mirror = _mirrored(bar)
    references = bar.references
    if len(references) == 2 and _are_exchanged(spectra, bar, mounting.channels[mirror]):
        mirror[references] = references[::-1]
    turned = np.diag((1.0, -1.0, 1.0)) @ mounting.rotation @ np.diag((1.0, -1.0, 1.0))
    return Mounting(mounting.channels[mirror], axes[mirror], mounting.gains[mirror], turned)


def _are_exchanged(spectra: Spectra, bar: MagnetometerBar, channels: npt.NDArray[np.intp]) -> bool:
    """Whether each of two references shares more noise with the far end of the array than with the near one."""
    near = far = 0.0
    for reference in bar.references:
        side = math.copysign(1.0, bar.positions_m[reference, 1])
        by_side = bar.array[np.argsort(-side * bar.positions_m[bar.array, 1])]
        for sensor, is_near in ((by_side[0], True), (by_side[-1], False)):
            one, two = spectra.quiet[:, :, reference], spectra.quiet[:, :, channels[sensor]]
            cross = np.abs(np.einsum("wfa,wfb->fab", one, two.conj())) ** 2
            own = np.einsum("wfa,wfb->fab", np.abs(one) ** 2, np.abs(two) ** 2)
            shared = float((cross / np.maximum(own, 1e-12)).sum())
            near, far = near + shared * is_near, far + shared * (not is_near)
    return far > near


# === Names.


def _common_axes(mounting: Mounting, bar: MagnetometerBar) -> Floats:
    """The axes that most sensors of the array have."""
    texts = [one.tobytes() for one in mounting.axes[bar.array]]
    most = max(texts, key=texts.count)
    return np.asarray(mounting.axes[bar.array][texts.index(most)])


def _undecided(axes: Floats) -> MountingFault:
    """What a bar may be like whose axes are all turned, on a drive that does not show which of these it is."""
    if np.count_nonzero(axes - np.diag(np.diag(axes))):
        name = f"the axes of all sensors are exchanged ({_axes_text(axes)}, or with some of these inverted)"
    else:
        name = "; or ".join(dict.fromkeys(_all_axes_text(*member) for member in _members(axes)))
    return MountingFault(
        "bar.sensors",
        name,
        "the magnets alone cannot decide between these; a drive with a bend of 60 degrees and headings can",
    )


def _members(axes: Floats) -> Iterator[tuple[Floats, bool]]:
    """Axes, and whether left and right are exchanged, of mountings that look alike; likely ones only."""
    for x, y in ((1, 1), (-1, -1), (1, -1), (-1, 1)):
        turn, mirrored = np.diag((x, y, x)) @ axes, x != y
        if (np.linalg.det(turn) > 0) or not mirrored:
            yield turn, mirrored


def _all_axes_text(axes: Floats, mirrored: bool) -> str:
    """What is wrong with all sensors."""
    signs = tuple(np.diag(axes).astype(int).tolist())
    if mirrored:
        known = {
            (1, 1, 1): "left and right of the bar are exchanged", (-1, -1, 1): "the bar is mounted backwards",
            (1, -1, -1): "the bar is mounted upside down, from side to side",
        }  # fmt: skip
        return known.get(signs, f"left and right of the bar are exchanged, and {_axes_text(axes)}")
    if signs == (1, -1, -1):
        return "the axes are FRD where FLU was declared or the other way round"
    return _axes_text(axes)


def _axes_text(axes: Floats) -> str:
    """What a signed permutation does to axes."""
    if np.count_nonzero(axes - np.diag(np.diag(axes))):
        rows = [
            f"{'xyz'[k]} is {'-' if axes[k].sum() < 0 else ''}{'xyz'[int(np.argmax(np.abs(axes[k])))]}"
            for k in range(3)
        ]
        return ", ".join(rows)
    inverted = [name for name, sign in zip("xyz", np.diag(axes), strict=True) if sign < 0]
    return f"{' and '.join(inverted)} {'is' if len(inverted) == 1 else 'are'} inverted"


def _describe(mounting: Mounting, bar: MagnetometerBar) -> Iterator[MountingFault]:
    """The faults of a mounting against the declared one."""
    common, same = _common_axes(mounting, bar), np.arange(bar.sensor_count)
    channels, mirror = mounting.channels, _mirrored(bar)
    known = next(((n, o) for n, o in _orders(bar).items() if np.array_equal(o[bar.array], channels[bar.array])), None)
    mirrored = np.mean(channels[bar.array] == mirror[bar.array]) > 0.5 and known is None
    if mirrored or not np.array_equal(common, np.eye(3)):
        field = "axes" if not mirrored else "bar.sensors"
        yield MountingFault(field, _all_axes_text(common, bool(mirrored)), "declare the axes and places as they are")
    if known is not None:
        yield MountingFault("bar.sensors", known[0], "declare the sensors in the order of the file")
    else:
        start = mirror if mirrored else same
        for j in bar.array:
            other = int(np.flatnonzero(start == channels[j])[0])
            if other > j:
                name = f"sensors {j + 1} and {other + 1} are exchanged"
                yield MountingFault("bar.sensors", name, "connect or declare them in their order")
    for j in bar.array:
        number = int(channels[j]) + 1
        if mounting.gains[j] == 0:
            yield MountingFault("bar.sensors", f"sensor {number} shows no field", "replace it; it is left out")
        elif not np.array_equal(mounting.axes[j], common):
            what = _axes_text(mounting.axes[j] @ common.T)
            turned = np.linalg.det(mounting.axes[j] @ common.T) > 0
            name = f"sensor {number} is turned over ({what})" if turned else f"of sensor {number}, {what}"
            yield MountingFault("bar.sensors", name, "turn the sensor, or declare its rotation")
    angle_deg = _yaw_deg(mounting)
    if abs(angle_deg) > MIN_TURN_DEG:
        side = "left" if angle_deg > 0 else "right"
        name = f"the bar is turned by {abs(angle_deg):.0f} degrees to the {side}"
        yield MountingFault("bar.sensors", name, "mount it across the vehicle, or declare where its sensors are")

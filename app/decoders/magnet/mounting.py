"""Whether a bar is mounted as declared: faults are compared by how well dipoles explain what the bar passes.

A magnet is a dipole, and so is much of the iron in a road. In the right mounting a dipole explains the field of an
event but for the errors of the sensors, in a wrong one it does not, wherever the dipole is and its moment points. So a
fault is likely where events that are no dipoles as declared become dipoles with it. Events that are no dipole in either
mounting, such as merged magnets and large iron, are ignored, and so is the absence of a field.

A dipole cannot show everything: all signs inverted is a dipole of the other polarity, and left and right exchanged with
y inverted a mirrored road. The earth's field while the vehicle turns, with its headings, shows which it is.

Shapes: K bins along the road, S sensors, A array sensors.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel
from app.decoders.magnet.dipole_fit import (
    UPRIGHT,
    FitData,
    MagnetPrior,
    Samples,
    dipole_field,
    fit_dipoles,
    remove_background,
    whiten,
)
from app.decoders.magnet.matched_filter import BIN_M
from app.decoders.magnet.readings import LikelyMistake
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace
from app.values import Bools, Floats

Indices = npt.NDArray[np.intp]

MIN_SENSORS = 6
"""Array sensors of a bar that is checked: a dipole has six parameters, and three sensors always see about one."""
HALF_WIDTH_M = 0.7
"""Road on each side of an event. [m] Over two heights of METRO's clearances."""
LAG_M = 0.6
"""Distance of the places with which the field is compared to find events. [m]"""
EVENTS_PER_SENSOR = 4
"""Strongest events of those that each sensor of the array sees best, and those that each reference sees best: what it
sees of magnets shows that it is none."""
QUIET_SHARE, QUIET_CHI2 = 0.2, 7.0
"""Share of the road that shows the noise, and that quantile of chi-squared with 11 degrees of freedom: 14 means of
10 cm less a parabola."""
LOUD_SHARE, LOUD_CHI2, REFERENCE_NOISE = 0.75, 13.7, 1.5
"""The same for reference sensors, and factor of their noise: that of a wheel, which is no dipole in the road, is louder
at some parts of a turn than at others."""
NOISE_BLOCKS = 300
"""Stretches by which the noise is estimated, about. For speed."""
MIN_BINS = 9
"""Bins of an event, at least: those that METRO has at 50 m/s."""
STARTS_M = (0.16, 0.35)
"""Heights above the dipole at which fits start. [m]"""
ANY_DIPOLE = MagnetPrior(4.0, 1e6, 0.3, 1e3, 1e6, 1e6)
"""A prior without weight."""
SPIKE_UT = 20.0
"""Deviation of one sensor from the samples before and after that is a fault, if fewer than three sensors have it."""

MODEL_SHARE = 0.01
"""Share of an event's energy that a dipole leaves in the right mounting. Source: gains of 2 %, axes that are 1.5
degrees off (data sheet of the MLX90393) and read one after the other leave 0.001 to 0.03 in simulated drives."""
HALF_DEGREES = 4.0
"""Half of the degrees of freedom of an event. Errors of a model are alike in neighbouring samples: so few."""
MOST = 10.0
"""Log odds of one event, at most."""
MAX_SHARE = 0.15
"""Largest share of an event's energy that a dipole leaves which explains it."""
SURE, MIN_SUPPORT, SUPPORTS = 20.0, 3, 2.5
"""Log odds by which a fault must be likelier than the declared mounting, events that must support it, and log odds of
an event that does. Source: `python -m benchmarks.magnets bars`: healthy bars reach 10 at most (a sensor beside a very
noisy wheel), and those without such wheels 0."""
UNREPORTED = 12.0
"""Log odds of a fault of the whole bar from which on no magnets are reported."""
DISTINCT = 8.0
"""Log odds by which a fault must be likelier than any other, to be corrected."""
FIRST_EVENTS, FIRST_ODDS = 4, 2.0
"""Events that a fault is tried on first, and log odds with which it is tried on all. For speed."""
SEEN_SHARE = 0.15
"""Share of an event's energy that a sensor must see for its faults to be tried."""

YAWS_DEG, MIN_YAW_DEG, MAX_YAW_DEG = (-18.0, -9.0, 9.0, 18.0), 4.0, 25.0
"""Rotations about the vertical that are tried first, and the smallest and largest that is corrected. [deg]"""
MAX_CURVATURE = 1 / 150.0
"""Of the road, above which an event shows no rotation: ahead of the rear axle, a bar moves at an angle. [1/m]"""
RATE_HZ, MIN_TURN_DEG = 5.0, 60.0
"""[Hz, deg] rate at which the earth's field is compared with the headings, and change of heading that it needs."""
MAX_RESIDUAL = 0.5
"""[amplitude] root mean square of what the turning field leaves, above which nothing is concluded."""
MAX_PHASE_DEG = 60.0
"""[deg] between the heading and the field's direction. Source: magnetic declination is below 30 degrees in inhabited
regions (World Magnetic Model), and iron adds some."""
MIRRORED = 2.0
"""[1] amplitude of the field that turns one way over that of the one that turns the other way."""


# === Events: what the bar passes.


@dataclass(frozen=True, slots=True, eq=False)
class Event:
    """The field about one place of the road."""

    s_m: Floats  # shape (K,): [m] along the road
    field_ut: Floats  # shape (K, S, 3)
    noise_ut: Floats  # shape (S, 3): of a bin
    wheel_noise_ut: Floats  # shape (S, 3): of a bin of a reference
    crab_rad: float  # from the vehicle's heading to the direction in which the bar moves, to the left
    curvature: float  # [1/m] of the road, by the headings


def find_events(trace: MagnetTrace, bar: MagnetometerBar) -> list[Event]:
    """The strongest events by the sensor that sees most of them, strongest first."""
    odometer = odometer_m(trace)
    starts = np.flatnonzero(np.diff((odometer / (2 * BIN_M)).astype(int), prepend=-1))
    counts = np.diff(starts, append=len(odometer))
    lag = round(LAG_M / (2 * BIN_M))
    if len(starts) < 4 * lag:
        return []
    flat = np.nan_to_num(trace.field_ut.reshape(len(odometer), -1))
    mean = (np.add.reduceat(flat, starts, axis=0) / counts[:, None]).reshape(len(starts), -1, 3)
    change = mean[lag:-lag] - (mean[: -2 * lag] + mean[2 * lag :]) / 2
    quiet, loud = _noise(mean, bar)
    each = ((change / quiet) ** 2).sum(axis=2)
    each = np.median(np.stack([each[:-2], each[1:-1], each[2:]]), axis=0)  # without spikes
    energy = each[:, bar.array].sum(axis=1)
    highest = np.max([np.roll(energy, k) for k in range(1 - lag, lag)], axis=0)
    peaks = np.flatnonzero(energy == highest)
    peaks = peaks[np.argsort(-energy[peaks], kind="stable")]
    loudest = bar.array[np.argmax(each[peaks][:, bar.array], axis=1)]
    chosen = np.zeros(len(peaks), bool)
    for sensor in bar.array:
        chosen[np.flatnonzero(loudest == sensor)[:EVENTS_PER_SENSOR]] = True
    for sensor in bar.references:
        chosen[np.argsort(-each[peaks, sensor], kind="stable")[:EVENTS_PER_SENSOR]] = True
    mean_of = math.sqrt(float(np.mean(1 / counts)))
    found = (
        _cut_event(
            trace, bar, odometer, float(odometer[starts[peak + lag + 1]]) + BIN_M, quiet / mean_of, loud / mean_of
        )
        for peak in peaks[chosen]
    )
    return [event for event in found if event is not None]


def _noise(mean: Floats, bar: MagnetometerBar) -> tuple[Floats, Floats]:
    """Noise of each channel (S, 3) as a sensor of the array and as a reference, of means (N, S, 3) of 10 cm."""
    size = round(HALF_WIDTH_M / BIN_M)
    blocks = mean[: len(mean) // size * size].reshape(-1, size, mean[0].size)
    blocks = blocks[:: max(len(blocks) // NOISE_BLOCKS, 1)]
    blocks = blocks - blocks.mean(axis=1, keepdims=True)
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, size), 3))[0]
    left = (blocks**2).sum(axis=1) - (np.einsum("kq,bkc->bqc", basis, blocks) ** 2).sum(axis=1)
    quiet, loud = (
        np.sqrt(np.maximum(np.quantile(left, share, axis=0) / chi2, 1e-6)).reshape(-1, 3)
        for share, chi2 in ((QUIET_SHARE, QUIET_CHI2), (LOUD_SHARE, LOUD_CHI2))
    )
    quiet = np.maximum(quiet, np.median(quiet[bar.array], axis=0) / 4)
    return quiet, REFERENCE_NOISE * np.maximum(loud, quiet)


def _cut_event(
    trace: MagnetTrace,
    bar: MagnetometerBar,
    odometer: Floats,
    middle_m: float,
    noise_ut: Floats,
    wheel_noise_ut: Floats,
) -> Event | None:
    """The field about a place, with noises per sample; None where it is not whole."""
    low, high = (int(k) for k in np.searchsorted(odometer, (middle_m - HALF_WIDTH_M, middle_m + HALF_WIDTH_M)))
    field = trace.field_ut[low:high]
    if high - low < MIN_BINS or not np.isfinite(field).all():
        return None
    s = odometer[low:high] - middle_m
    length_m, turned = float(s[-1] - s[0]), 0.0
    bins = np.floor(s / BIN_M).astype(int)
    starts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
    if len(starts) < MIN_BINS or length_m < 1.6 * HALF_WIDTH_M:
        return None
    counts = np.diff(starts, append=len(bins))
    if trace.heading_t_s is not None and trace.heading_deg is not None and len(trace.heading_t_s):
        ends = np.interp((trace.t_s[low], trace.t_s[high - 1]), trace.heading_t_s, np.arange(len(trace.heading_t_s)))
        first, last = int(ends[0]), int(ends[1]) + 2
        yaw = np.unwrap(np.radians(-trace.heading_deg[first:last]))
        turned = float(np.diff(np.interp(ends - first, np.arange(len(yaw)), yaw))[0])
    forward_m = float(np.mean(bar.positions_m[bar.array, 0]))
    return Event(
        np.add.reduceat(s, starts) / counts,
        np.add.reduceat(without_spikes(field), starts, axis=0) / counts[:, None, None],
        noise_ut * math.sqrt(float(np.mean(1 / counts))),
        wheel_noise_ut * math.sqrt(float(np.mean(1 / counts))),
        math.atan(forward_m * turned / length_m),
        abs(turned) / length_m,
    )


def odometer_m(trace: MagnetTrace) -> Floats:
    """Distance driven at each sample. [m]"""
    speed = np.abs(np.interp(trace.t_s, trace.speed_t_s, trace.speed_m_s))
    return np.concatenate([[0.0], np.cumsum(np.diff(trace.t_s) * (speed[1:] + speed[:-1]) / 2)])


def without_spikes(field_ut: npt.NDArray[np.floating]) -> Floats:
    """Samples (N, S, 3) with spikes of single sensors replaced."""
    field: Floats = field_ut.astype(float)
    middle = np.median(np.stack([field[:-2], field[1:-1], field[2:]]), axis=0)
    off = np.abs(field[1:-1] - middle).max(axis=2)
    alone = off > SPIKE_UT + np.sort(off, axis=1)[:, -3:-2]
    field[1:-1][alone] = middle[alone]
    return field


# === What is compared.


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """How the channels of a recording belong to the sensors of the declared bar."""

    channels: Indices  # shape (S,): channel of each sensor
    signs: Floats  # shape (S, 3): of the axes of each sensor, in the declared order
    dead: Bools  # shape (S,): channels that show nothing
    yaw_rad: float = 0.0  # of the array against the declared one, to the left

    @classmethod
    def declared(cls, sensors: int) -> Mounting:
        """That of the declaration."""
        return cls(np.arange(sensors), np.ones((sensors, 3)), np.zeros(sensors, bool))


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    """A fault that is tried."""

    fault: LikelyMistake  # of the declaration
    mounting: Mounting


@dataclass(frozen=True, slots=True, eq=False)
class _Family:
    """Faults that are tried together, as the same fits of dipoles show them."""

    members: tuple[_Hypothesis, ...]
    sensors: tuple[int, ...] = ()  # that differ, counted from 0; none where all do
    left_out: int | None = None  # sensor whose field is predicted by a dipole that is fitted to all others
    references: tuple[int, ...] = ()  # channels that are references as declared or with the fault


@dataclass(frozen=True, slots=True, eq=False)
class _Misfit:
    """How a dipole explains an event."""

    share: float  # of the energy that it leaves, beyond the noise
    floor: float  # share that it may leave by errors of the model and chance
    by_sensor: Floats  # shape (A,), or (S,) with references: share of each sensor in the energy

    def odds_of(self, other: _Misfit) -> float:
        """Log odds of another mounting's misfit: Gaussian errors in proportion to the field, of unknown size.

        An event speaks for another mounting only if it is a dipole there.
        """
        floor = max(self.floor, other.floor)
        odds = float(np.clip(HALF_DEGREES * math.log((self.share + floor) / (other.share + floor)), -MOST, MOST))
        return odds if other.share < MAX_SHARE else min(odds, 0.0)

    @property
    def may_gain(self) -> bool:
        """Whether the event may support another mounting: a dipole cannot become more of one."""
        return HALF_DEGREES * math.log((self.share + self.floor) / self.floor) > SUPPORTS


@ieee_kernel
def fit_any_dipole(data: FitData, seen: FitData, start: Floats, prior: MagnetPrior) -> Floats:
    """What the dipole shows that explains data best, of any place and moment, from a start (6,).

    Returns
    -------
    ndarray, shape (S, 3, 3)
        Of each sensor and axis of what is seen: energy, energy of the field of the dipole, and product of both.
    """
    kinds = np.full(1, UPRIGHT, np.int64)
    dipole = fit_dipoles(data, start.reshape(1, 6), kinds, prior).dipoles[0]
    model = np.empty(seen.field.shape)
    dipole_field(dipole, seen, model)
    remove_background(model, seen.basis, seen.common_share)
    sensors, axes, bins = seen.field.shape
    out = np.zeros((sensors, axes, 3))
    for j in range(sensors):
        for axis in range(axes):
            for k in range(bins):
                one, two = seen.field[j, axis, k], model[j, axis, k]
                out[j, axis, 0] += one * one
                out[j, axis, 1] += two * two
                out[j, axis, 2] += one * two
    return out


class MountingModel:
    """How well dipoles explain the events of a recording in a mounting."""

    def __init__(self, events: Sequence[Event], bar: MagnetometerBar) -> None:
        self.events, self.bar, self.array = events, bar, bar.array
        self._positions_m = bar.positions_m - bar.positions_m[self.array].mean(axis=0)
        self.beside = {
            j: self.array[np.argsort(abs(bar.positions_m[self.array, 1] - bar.positions_m[j, 1]), kind="stable")[:3]]
            for j in self.array.tolist()
        }
        self._known: dict[tuple[int, ...], list[_Misfit]] = {}

    def declared(self, references: tuple[int, ...] = ()) -> list[_Misfit]:
        """Misfits of all events in the declared mounting."""
        if references not in self._known:
            same = Mounting.declared(self.bar.sensor_count)
            self._known[references] = [self.misfit(one, same, references) for one in self.events]
        return self._known[references]

    def misfits(self, event: Event, family: _Family) -> list[_Misfit]:
        """How dipoles explain an event with each of the faults of a family."""
        if family.left_out is None:
            return [self.misfit(event, one.mounting, family.references) for one in family.members]
        same = Mounting.declared(self.bar.sensor_count)
        others = self.array[self.array != family.left_out]
        figures, chance = self._explain(event, same, self.array, others)
        j = int(np.flatnonzero(self.array == family.left_out)[0])
        apart = float((figures[:, :, 0] + figures[:, :, 1] - 2 * figures[:, :, 2]).sum() - _left(figures[j]))
        shown = []
        for one in family.members:
            gains = np.where(one.mounting.dead[family.left_out], 0.0, one.mounting.signs[family.left_out])
            own = figures[j, :, 0] + gains**2 * figures[j, :, 1] - 2 * gains * figures[j, :, 2]
            shown.append(_judge(figures, apart + float(own.sum()), chance))
        return shown

    def misfit(self, event: Event, mounting: Mounting, references: tuple[int, ...] = ()) -> _Misfit:
        """How the best dipole explains an event."""
        sensors = np.arange(self.bar.sensor_count) if references else self.array
        figures, chance = self._explain(event, mounting, sensors, sensors, references)
        return _judge(figures, _left(figures), chance)

    def _explain(
        self, event: Event, mounting: Mounting, sensors: Indices, fitted: Indices, references: tuple[int, ...] = ()
    ) -> tuple[Floats, int]:
        """What the best dipole shows at sensors, fitted to some of them, and their degrees of freedom."""
        c, n = math.cos(mounting.yaw_rad - event.crab_rad), math.sin(mounting.yaw_rad - event.crab_rad)
        turn = np.array([[c, -n, 0.0], [n, c, 0.0], [0.0, 0.0, 1.0]])
        places, channels = self._positions_m[sensors] @ turn.T, mounting.channels[sensors]
        field = (event.field_ut[:, channels] * mounting.signs[sensors]) @ turn.T
        is_reference = np.isin(channels, references)[:, None]
        noise_ut = np.where(is_reference, event.wheel_noise_ut[channels], event.noise_ut[channels])
        noise = np.sqrt(noise_ut**2 @ (turn**2).T)
        bins = len(event.s_m)
        noise *= math.sqrt((event.s_m[-1] - event.s_m[0]) / (bins - 1) / BIN_M)  # as `whiten` takes it
        samples = Samples(
            event.s_m,
            np.ascontiguousarray(field.transpose(1, 2, 0)),
            np.ones((len(sensors), bins)),
            1 / noise,
            _NOTHING,
        )
        white, weight, basis = whiten(samples, 0, bins, _ONES, np.zeros((bins, len(sensors), 3), np.float32), 2)
        seen = FitData(event.s_m, white, weight, np.zeros((3, bins)), places, basis, _NOTHING)
        energy = (white**2).sum(axis=(1, 2))
        chosen = np.isin(sensors, fitted)
        data = seen
        if not chosen.all():
            data = seen._replace(
                field=np.ascontiguousarray(white[chosen]), weight=np.ascontiguousarray(weight[chosen]),
                positions_m=np.ascontiguousarray(places[chosen]),
            )  # fmt: skip
        strong = np.where(chosen, energy, 0.0) ** 2
        y = float(strong @ places[:, 1] / max(strong.sum(), 1e-12))
        chance = white.size - 3 * len(basis) * len(sensors)
        best = None
        for height in STARTS_M:
            figures = fit_any_dipole(data, seen, np.array([0.0, y, height, 0, 0, 0]), ANY_DIPOLE)
            if best is None or _left(figures[chosen]) < _left(best[chosen]):
                best = figures
            if _left(best) < chance + MODEL_SHARE * float(energy.sum()):
                break
        assert best is not None
        return best, chance


_NOTHING, _ONES = np.zeros(3), np.ones(3)


def _left(figures: Floats) -> float:
    """Energy that a dipole leaves, of figures of `fit_any_dipole`."""
    return float((figures[..., 0] + figures[..., 1] - 2 * figures[..., 2]).sum())


def _judge(figures: Floats, left: float, chance: int) -> _Misfit:
    energy = figures[:, :, 0].sum(axis=1)
    signal = max(float(energy.sum()) - chance, 1.0)
    floor = MODEL_SHARE + 2 * math.sqrt(2 * chance) / signal
    share = min(max(left - chance, 0.0) / signal, 1.0)
    return _Misfit(share, floor, energy / max(float(energy.sum()), 1e-12))


# === The search.


@dataclass(frozen=True, slots=True, eq=False)
class MountingCheck:
    """What a recording shows of its bar's mounting."""

    mounting: Mounting | None  # that explains the recording; None where it cannot be decided
    faults: tuple[LikelyMistake, ...] = ()  # none where the bar is as declared


def check_mounting(trace: MagnetTrace, bar: MagnetometerBar) -> MountingCheck:
    """Compare faults of a bar with its recording; one that explains it beyond all others is corrected."""
    declared = Mounting.declared(bar.sensor_count)
    if len(bar.array) < MIN_SENSORS:
        return MountingCheck(declared)
    model = MountingModel(find_events(trace, bar), bar)
    if sum(one.may_gain for one in model.declared()) < MIN_SUPPORT:
        return MountingCheck(declared)
    found = sorted(likely_faults(model, trace), key=lambda one: -one[0])
    if not found or found[0][0] < (SURE if found[0][2].sensors else UNREPORTED):
        return MountingCheck(declared)
    # what was left off early may be as likely as what was found
    whole = [one for family in _families(model, trace) if not family.sensors for one in _judged(model, family, True)]
    found = sorted([*(one for one in found if one[2].sensors), *whole], key=lambda one: -one[0])
    odds, best, family = found[0]
    rivals = [one for one in found[1:] if one[0] > odds - DISTINCT]
    if family.left_out is not None and rivals and all(other is family for _, _, other in rivals):
        return _without_sensor(best, family.left_out, bar)
    if rivals or odds < SURE:
        names = dict.fromkeys(name for _, one, _ in (found[0], *rivals) for name in _names(one))
        fault = LikelyMistake("bar.sensors", "; or ".join(names), "check the order and axes of all sensors")
        return MountingCheck(None, (fault,))
    if not family.sensors and (best.mounting.signs != 1).any():
        return _decide_by_earth(best, trace, bar)
    return MountingCheck(best.mounting, (best.fault,))


_Judged = tuple[float, _Hypothesis, _Family]
"""Log odds of a fault against the declared mounting, and the fault."""


def likely_faults(model: MountingModel, trace: MagnetTrace) -> Iterator[_Judged]:
    """Faults that may be likelier than the declared mounting."""
    for family in _families(model, trace):
        yield from _judged(model, family)


def _judged(model: MountingModel, family: _Family, whole: bool = False) -> Iterator[_Judged]:
    """The faults of a family that may be likelier than the declared mounting, tried on all events or on few first."""
    odds = _log_odds(model, family, whole)
    found = [(one, member, family) for one, member in zip(odds, family.members, strict=True) if one > 0]
    if found and family.members[0].mounting.yaw_rad:  # rotations that are near each other are no rivals
        best = max(found, key=lambda one: one[0])
        yield best if best[0] < UNREPORTED else _refined(model, *best)
    else:
        yield from found


def _log_odds(model: MountingModel, family: _Family, whole: bool = False) -> list[float]:
    """Log odds of each fault of a family against the declared mounting; 0 where they are low."""
    none = [0.0] * len(family.members)
    declared = model.declared(family.references)
    turned = bool(family.members[0].mounting.yaw_rad)
    usable = [k for k, event in enumerate(model.events) if not turned or event.curvature < MAX_CURVATURE]
    weights = _seen_shares(declared, family, model)
    may_gain = [k for k in usable if declared[k].may_gain and weights[k] > SEEN_SHARE]
    if len(may_gain) < MIN_SUPPORT:
        return none
    may_gain.sort(key=lambda k: -weights[k])
    others = [k for k in usable if k not in may_gain and weights[k] > SEEN_SHARE]
    first = len(may_gain) if family.references else FIRST_EVENTS  # few events show which sensors are references
    rows: list[list[float]] = []
    for k in (*may_gain, *others):
        rows.append([declared[k].odds_of(one) for one in model.misfits(model.events[k], family)])
        best = float(np.sum(rows, axis=0).max())
        is_low = (len(rows) == first and best < FIRST_ODDS) or (len(rows) == len(may_gain) and best < UNREPORTED)
        if is_low and not whole:
            return none
    supports = (np.array(rows) > SUPPORTS).sum(axis=0)
    return [float(odds) if n >= MIN_SUPPORT else 0.0 for odds, n in zip(np.sum(rows, axis=0), supports, strict=True)]


def _seen_shares(declared: Sequence[_Misfit], family: _Family, model: MountingModel) -> list[float]:
    """Share of each event that the sensors of a fault and their neighbours see."""
    if not family.sensors:
        return [1.0] * len(declared)
    near = {int(k) for j in family.sensors for k in model.beside[j]}
    of_array = np.array([float(j in near) for j in model.array.tolist()])
    shares: list[float] = (np.stack([one.by_sensor for one in declared]) @ of_array).tolist()
    return shares


def _refined(
    model: MountingModel, odds: float, one: _Hypothesis, family: _Family
) -> tuple[float, _Hypothesis, _Family]:
    """The likeliest rotation of a bar near one that was tried."""
    for step_deg in (5.0, 2.5, 1.5):
        around = [math.degrees(one.mounting.yaw_rad) + side * step_deg for side in (-1, 1)]
        members = tuple(_turned(angle, model.bar) for angle in around if MIN_YAW_DEG <= abs(angle) <= MAX_YAW_DEG)
        for other, member in zip(_log_odds(model, replace(family, members=members)), members, strict=True):
            if other > odds:
                odds, one = other, member
    return odds, one, family


def _families(model: MountingModel, trace: MagnetTrace) -> Iterator[_Family]:
    """Single causes: a sensor, exchanged neighbours, another order, other axes of all sensors, a turned bar."""
    bar = model.bar
    same = Mounting.declared(bar.sensor_count)
    for j in bar.array.tolist():
        dead = LikelyMistake("bar.sensors", f"sensor {j + 1} shows no field", "replace it; it is left out")
        members = [_Hypothesis(dead, replace(same, dead=_at(j, bar)))]
        for signs in itertools.product((1.0, -1.0), repeat=3):
            if min(signs) < 0:
                turned = np.where(_at(j, bar)[:, None], signs, same.signs)
                members.append(_Hypothesis(_sensor_fault(j, signs), replace(same, signs=turned)))
        yield _Family(tuple(members), (j,), left_out=j)
    by_place = bar.array[np.argsort(bar.positions_m[bar.array, 1], kind="stable")].tolist()
    for a, b in itertools.pairwise(by_place):
        order = same.channels.copy()
        order[[a, b]] = b, a
        low, high = sorted((a + 1, b + 1))
        name = f"sensors {low} and {high} are exchanged"
        fault = LikelyMistake("bar.sensors", name, "connect or declare them in their order")
        yield _Family((_Hypothesis(fault, replace(same, channels=order)),), (a, b))
    for name, order in _orders(bar).items():
        fault = LikelyMistake("bar.sensors", name, "declare the sensors in the order of the file")
        moved = () if np.isin(order[bar.array], bar.array).all() else (*bar.references, *order[bar.references])
        yield _Family((_Hypothesis(fault, replace(same, channels=order)),), references=tuple(int(k) for k in moved))
    for axis in range(3):
        signs_of_all = np.tile(np.where(np.arange(3) == axis, -1.0, 1.0), (bar.sensor_count, 1))
        fault = LikelyMistake("axes", _axes_text(signs_of_all[0]), "declare the axes as they are")
        yield _Family((_Hypothesis(fault, replace(same, signs=signs_of_all)),))
    if trace.heading_t_s is not None and len(trace.heading_t_s):
        yield _Family(tuple(_turned(angle_deg, bar) for angle_deg in YAWS_DEG))


def _turned(angle_deg: float, bar: MagnetometerBar) -> _Hypothesis:
    name = f"the bar is turned by {abs(angle_deg):.0f} degrees to the {'left' if angle_deg > 0 else 'right'}"
    fault = LikelyMistake("bar.sensors", name, "mount it across the vehicle, or declare where its sensors are")
    return _Hypothesis(fault, replace(Mounting.declared(bar.sensor_count), yaw_rad=math.radians(angle_deg)))


def _at(sensor: int, bar: MagnetometerBar) -> Bools:
    return np.asarray(np.arange(bar.sensor_count) == sensor)


def _orders(bar: MagnetometerBar) -> dict[str, Indices]:
    """Other orders of the sensors than the declared one, by name; channel of each sensor."""
    same = np.arange(bar.sensor_count)
    mirrored = _mirrored(bar)
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
    alike = (same[bar.array], mirrored[bar.array])
    return {n: order for n, order in found.items() if not any(np.array_equal(order[bar.array], one) for one in alike)}


def _mirrored(bar: MagnetometerBar) -> Indices:
    """Channel of each sensor where left and right of the array are exchanged."""
    channels = np.arange(bar.sensor_count)
    by_place = bar.array[np.argsort(bar.positions_m[bar.array, 1])]
    channels[by_place] = by_place[::-1]
    return channels


# === Which of the mountings that look alike from below it is.


def _decide_by_earth(best: _Hypothesis, trace: MagnetTrace, bar: MagnetometerBar) -> MountingCheck:
    """The mounting that looks like one with these signs of all axes, and by which the earth's field turns."""
    decided = _signs_by_earth(turning_field(as_declared(best.mounting, trace, bar), bar))
    if decided is None:
        cure = "the magnets alone cannot decide between these; a drive with a bend of 60 degrees and headings can"
        return MountingCheck(None, (LikelyMistake("bar.sensors", "; or ".join(_names(best)), cure),))
    x, y = decided
    found = replace(best.mounting, signs=best.mounting.signs * (x, y, x))
    if x != y:
        found = replace(found, channels=_mirrored(bar))
    name = _all_axes_text(found.signs[0], x != y)
    cure = "declare the axes and places as they are"
    return MountingCheck(found, (LikelyMistake("bar.sensors" if x != y else "axes", name, cure),))


def _names(one: _Hypothesis) -> list[str]:
    """What a fault may be: axes of all sensors look like others that somebody may have caused."""
    signs = one.mounting.signs[0]
    if not (one.mounting.signs != 1).all(axis=0).any():
        return [one.fault.reason]
    alike = [(signs * (x, y, x), x != y) for x, y in ((1, 1), (-1, -1), (1, -1), (-1, 1))]
    # a rotation, or one cause alone
    return [_all_axes_text(*other) for other in alike if np.prod(other[0]) > 0 or not other[1]]


def turning_field(trace: MagnetTrace, bar: MagnetometerBar) -> tuple[complex, complex] | None:
    """Amplitudes of the earth's horizontal field that turn with the heading and against it; None on a straight drive.

    With x forward, y left and the heading h clockwise from north, x + iy of the earth's field is H exp(i (h - D)) and
    constant offsets, where D is the declination. One more term, in exp(-ih), is left where an axis is mirrored. [uT]
    """
    if trace.heading_t_s is None or trace.heading_deg is None or not len(trace.heading_t_s):
        return None
    step = max(round(trace.rate_hz / RATE_HZ), 1)
    field: Floats = np.nanmedian(trace.field_ut[::step][:, bar.array], axis=1).astype(float)
    heading = np.interp(trace.t_s[::step], trace.heading_t_s, np.unwrap(np.radians(trace.heading_deg)))
    known = np.isfinite(field).all(axis=1)
    if known.sum() < 20 or np.ptp(heading[known]) < np.radians(MIN_TURN_DEG):
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


def as_declared(mounting: Mounting, trace: MagnetTrace, bar: MagnetometerBar) -> MagnetTrace:
    """The recording as the declared bar would have made it; NaN of dead sensors."""
    field = trace.field_ut[:, mounting.channels] * mounting.signs.astype(np.float32)
    if mounting.yaw_rad:
        c, n = math.cos(mounting.yaw_rad), math.sin(mounting.yaw_rad)
        turn = np.array([[c, -n, 0.0], [n, c, 0.0], [0.0, 0.0, 1.0]])
        places = bar.positions_m - bar.positions_m[bar.array].mean(axis=0)
        ahead = (places @ turn.T - places)[:, 0]
        odometer = odometer_m(trace)
        odometer += 1e-9 * np.arange(len(odometer))  # also rises where the vehicle stands
        field[:, bar.array] = without_spikes(field[:, bar.array] @ turn.T.astype(np.float32))
        for j, axis in itertools.product(bar.array, range(3)):  # as if it were where it was declared
            field[:, j, axis] = np.interp(odometer - ahead[j], odometer, field[:, j, axis])
    field[:, mounting.dead[mounting.channels]] = np.nan
    return replace(trace, field_ut=field)


# === Names.


def _without_sensor(best: _Hypothesis, sensor: int, bar: MagnetometerBar) -> MountingCheck:
    """A sensor that fails in a way that cannot be decided is left out."""
    name = f"sensor {sensor + 1} does not read what its neighbours do (most likely, {best.fault.reason})"
    fault = LikelyMistake("bar.sensors", name, "check or replace it; it is left out")
    return MountingCheck(replace(Mounting.declared(bar.sensor_count), dead=_at(sensor, bar)), (fault,))


def _sensor_fault(sensor: int, signs: tuple[float, ...]) -> LikelyMistake:
    what = _axes_text(np.array(signs))
    turned = math.prod(signs) > 0
    name = f"sensor {sensor + 1} is turned over ({what})" if turned else f"of sensor {sensor + 1}, {what}"
    return LikelyMistake("bar.sensors", name, "turn the sensor, or declare its rotation")


def _axes_text(signs: Floats) -> str:
    inverted = [name for name, sign in zip("xyz", signs, strict=True) if sign < 0]
    return f"{' and '.join(inverted)} {'is' if len(inverted) == 1 else 'are'} inverted"


def _all_axes_text(signs: Floats, mirrored: bool) -> str:
    """What is wrong with all sensors."""
    key = (int(signs[0]), int(signs[1]), int(signs[2]))
    if mirrored:
        known = {
            (1, 1, 1): "left and right of the bar are exchanged", (-1, -1, 1): "the bar is mounted backwards",
            (1, -1, -1): "the bar is mounted upside down, from side to side",
        }  # fmt: skip
        return known.get(key, f"left and right of the bar are exchanged, and {_axes_text(signs)}")
    if key == (1, -1, -1):
        return "the axes are FRD where FLU was declared or the other way round"
    return _axes_text(signs)

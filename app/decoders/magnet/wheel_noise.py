"""Cancellation of the noise of magnetised wheels, which repeats with each turn of a wheel.

A wheel's field at a sensor is a sum of harmonics of its rotation (rotating dipoles in its belt), the same turn after
turn. A bar sensor and a reference sensor see it in different shape and phase, so the reference itself cannot be
subtracted. It gives the length of a turn; the harmonics are then learnt for each channel by least mean squares
(the adaptive notch filter of Widrow et al., Adaptive noise cancelling: principles and applications, 1975).

Shapes: W wheels, S sensors, L trial circumferences, H harmonics by which the turn is found.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import kernel, routine
from app.values import Bools, Floats, Ints

# Distances over which the filter learns, in turns of some two metres, and limits of what a wheel can be like. They were
# chosen where no measurement stands beside them. `python -m benchmarks.magnets wheel drawn` checks them: the passes of
# METRO's section 7.2, and magnets that are found beside wheels of any strength.

# Length of a turn.
CIRCUMFERENCES_M = np.geomspace(1.6, 2.4, 64)
"""[m] trial lengths: rolling circumferences of car tyres; steps of 0.6 %, refined by a parabola."""
BANK_HARMONICS = 6  # by which the length is found
BANK_M = 30.0  # [m] over which it is found
RENEW_M = 0.1  # [m] after which the bank of trial lengths is renewed, for speed
MIN_PERIODIC, STILL_PERIODIC = 1.8, 1.0
"""Energy of a reference's signal that repeats with the turns, for a wheel to count as noisy and to go on doing so,
over what white noise has on average in as many harmonics. The best of 64 trial lengths has 1.7 at most in 90 drives of
150 m of white noise."""
START_M = 8.0  # [m] before a wheel can count as noisy, and for which a magnet is not looked for
STEER_M, FOLLOW_M = 4.0, 12.0
"""[m] over which the phase of a turn follows the noise at its reference, and that since the wheel was found noisy from
which on it does. In drives with strong wheels at 40 cm as many magnets are read with 2 to 8 m."""
MAX_STEP_M = 0.5  # [m] longest step between two blocks: longer ones are gaps
FIRST_LENGTH_M = 2.0  # [m] of a turn, assumed at first: the range's middle

# What is learnt of each channel.
HARMONICS = 8  # of a turn that are cancelled
OFFSET_M, FIRST_OFFSET_M = 6.0, 0.5  # [m] over which a channel's offset is averaged, in the long run and at first
LEARN_M, FIRST_LEARN_M, LEARN_SLOPE = 60.0, 3.0, 0.6
"""[m, m, 1] distance over which harmonics are learnt: in the long run, at first, and its growth per distance. In less,
the magnets of a line that are about as far apart as a turn is long are learnt too (decision 0014)."""
NEAR_M = 0.3
"""[m] added to the distance of a sensor from a reference, which is that far from the wheel; with 0.8 m as many magnets
are read."""
STRENGTH_M = 10.0  # [m] over which the strengths of noise and residual are averaged
CLIP = 3.0  # [mean deviations] up to which a residual counts
FIRST_CLIP, FIRST_CLIP_M = 3.0, 6.0  # [1, m] factor on it over the first metres
OUTLIER_CHANNELS = 3  # off by more than `CLIP` deviations are a magnet or iron, from which nothing is learnt
MAGNET_RATE = 0.1  # factor on the rate at which the residual's strength follows over a magnet
MEAN_DEVIATION = 1.25
"""Standard deviation over mean absolute deviation of Gaussian noise: sqrt(pi / 2)."""
MEDIAN_DEVIATION, MIN_ERROR_UT = 1.48, 1.0
"""[1, uT] deviation over median deviation of Gaussian noise, and the least deviation: a chip's."""
FIRST_ERROR_UT = 3.0  # [uT] residual that is assumed at first: twice a chip's noise
SMOOTH_M, MIN_STEP_M = 4.0, 0.001  # [m] of the moving mean that is taken off a beginning, and the least mean step

# What is taken out.
FADE_AFTER_M, FADE_M = 3.0, 8.0  # [m] since a wheel was found noisy, from which on and over which it grows to all
HALF_GAIN = 0.1  # strength of the noise over the residual's variance at which half of it is taken out
MAX_RISE, MAX_RISE_NEAR = 0.45, 0.9
"""Largest strength of a wheel's noise at a sensor over the sum at the two beside it, as it falls away; the same near
the wheel. 1,000 such wheels have up to 0.42 and 1.09; 99 % have up to 0.77 near the wheel."""
FAR_M, NEAR_WHEEL_M, APART_M = 0.25, 0.1, 0.12
"""[m] distance across from a reference from which on `MAX_RISE` holds, up to which nothing is strange; least distance
of sensors beside: less than METRO's spacing of 16 cm."""
MIN_STRANGE = 0.3
"""Strength that is never strange, over the residual's variance: white noise is learnt as well. With 0.1, wheels with
0.7 A m2 were no longer cancelled at 35 cm."""
GATE_OPENS, GATE_M = 0.8, 2.0  # [1, m] share of every limit below which noise is taken out again; distance of fading


# What is the same in every turn (`WheelNoiseCanceller.constant_turns`).
FIRST_TURNS, MIN_TURNS = 4, 3
"""Turns in a row from which on like ones are searched, and fewest that are alike. Source: a line may begin 8 m after a
recording, where its wheels are known."""
PRICE = 5.0
"""Log likelihood of something else in a turn, above that of noise, from which on it counts as there. With 10 turns over
lines beyond the bar's ends pass for turns without."""
MAX_ROUNDS, POWER_ROUNDS = 20, 4  # of the search, and of the estimate of a wheel's strength
SAME_SHARE = 0.7  # of turns in common, from which on two results are the same
FIRST_POWER_UT2, MIN_VARIANCE_UT2 = 50.0, 1e-3  # [uT2] of a wheel's harmonics at its reference, at first and at least


class _Progress:
    """How far a drive has come: a record, of whose fields these are names and types."""

    has_begun: bool
    odometer_m: float  # of the newest block
    yaw_rad: float  # of the newest block
    driven_m: float
    errors_known: bool  # deviations of the residuals were estimated beforehand
    is_strange: bool  # what was learnt cannot be a wheel's
    held_back_m: float  # for which that was so
    gate: float  # how much of the noise is taken out: it falls to 0 while that is so


_PROGRESS = np.dtype((np.record, list(_Progress.__annotations__.items())))


class _Trials(NamedTuple):
    """Memory for one harmonic of a turn of each trial length, each of shape (L,)."""

    cosine: Floats  # of the turn
    sine: Floats
    cosine_h: Floats  # of its harmonic h
    sine_h: Floats
    energy: Floats  # of the signal in all harmonics


class _Turns(NamedTuple):
    """The rotation of the wheels, as the references see it."""

    references: Ints  # (W,) reference sensors
    left_m: Floats  # (W,) of the middle of the vehicle
    rolled_m: Floats  # (W,) so far
    lengths_m: Floats  # (L,) trial lengths
    bank: Floats  # (W, 2, H, 3, L) running correlations with the cosine and sine of each trial length
    trials: _Trials
    power: Floats  # (W, 3) running signal power [uT2 m]
    pending_m: Floats  # (W,) distance since the bank was renewed
    pending_ut_m: Floats  # (W, 3) integral of the signal over it
    length_m: Floats  # (W,) of a turn
    periodic: Floats  # (W,) energy that repeats with the turns, over what white noise has in as many harmonics
    phase: Floats  # (W,) of the turn [rad]
    locked_m: Floats  # (W,) distance since the wheel was found noisy


class _Channels(NamedTuple):
    """What was learnt of each channel."""

    offset: Floats  # (S, 3) [uT]
    weights: Floats  # (S, 3, 2 W HARMONICS) cosine and sine of each harmonic [uT]
    error: Floats  # (S, 3) deviation of the residual [uT]
    strength: Floats  # (S, 3) mean square of the noise [uT2]
    residual: Floats  # (S, 3) of the present block [uT]
    regressors: Floats  # (2 W HARMONICS,) of the present block
    near: Floats  # (S, W) how much of its noise a sensor can have from each wheel, 1 for the nearest


class _Limits(NamedTuple):
    """The most noise that a wheel can have at each sensor."""

    rise: Floats  # (S,) strength over the sum of those at the sensors beside
    beside: Ints  # (S, 2) these sensors, -1 where a wheel may be as loud


class ConstantTurns:
    """Noise of wheels that is the same in every turn, of a stretch of road.

    Parameters
    ----------
    s : ndarray, shape (N,)
        Odometers. [m]
    phases : ndarray, shape (N, W)
        Of the wheels there, unwrapped. [rad]
    weights : ndarray, shape (S, 3, 2 W HARMONICS)
        Cosine and sine of each harmonic. [uT]
    """

    def __init__(self, s: Floats, phases: Floats, weights: Floats) -> None:
        self._s = s
        self._phases = phases
        self._weights = weights

    def noise_ut(self, s: Floats) -> Floats:
        """The noise of each sensor at odometers s (N,), shape (N, S, 3). [uT]"""
        phases = np.array([np.interp(s, self._s, of_wheel) for of_wheel in self._phases.T]).T
        return np.asarray(np.einsum("nk,sak->nsa", _regressors(phases), self._weights))

    def moved(self, by_m: float) -> ConstantTurns:
        """The same where odometers are larger. [m]"""
        return ConstantTurns(self._s + by_m, self._phases, self._weights)


class Piece(NamedTuple):
    """A piece of the road, and what the wheels' noise is there: the same in every turn, or nothing."""

    start_m: float
    stop_m: float
    turns: ConstantTurns | None


class WheelNoiseCanceller:
    """Takes wheel noise out of blocks, in their order.

    Parameters
    ----------
    references : ndarray of int
        Reference sensors, one for each wheel; without any, nothing is changed.
    positions_m : ndarray, shape (S, 3)
        Of all sensors. [m]
    """

    def __init__(self, references: npt.NDArray[np.intp], positions_m: Floats) -> None:
        sensors = len(positions_m)
        wheels, regressors = len(references), 2 * len(references) * HARMONICS
        lengths = CIRCUMFERENCES_M.size
        self._turns = _Turns(
            references=references.astype(np.int64),
            left_m=np.ascontiguousarray(positions_m[references, 1]),
            rolled_m=np.zeros(wheels),
            lengths_m=CIRCUMFERENCES_M.copy(),
            bank=np.zeros((wheels, 2, BANK_HARMONICS, 3, lengths)),
            trials=_Trials(*np.zeros((5, lengths))),
            power=np.zeros((wheels, 3)),
            pending_m=np.zeros(wheels),
            pending_ut_m=np.zeros((wheels, 3)),
            length_m=np.full(wheels, FIRST_LENGTH_M),
            periodic=np.zeros(wheels),
            phase=np.zeros(wheels),
            locked_m=np.zeros(wheels),
        )
        self._channels = _Channels(
            offset=np.zeros((sensors, 3)),
            weights=np.zeros((sensors, 3, regressors)),
            error=np.full((sensors, 3), FIRST_ERROR_UT),
            strength=np.zeros((sensors, 3)),
            residual=np.zeros((sensors, 3)),
            regressors=np.zeros(regressors),
            near=_nearness(positions_m, references),
        )
        self._limits = _wheel_limits(positions_m, references)
        self._progress = np.zeros(1, _PROGRESS)
        self._pieces: tuple[Piece, ...] = ()

    def with_pieces(self, pieces: Sequence[Piece]) -> WheelNoiseCanceller:
        """A copy that takes out, over some pieces of the road, what was found for them."""
        copy = deepcopy(self)
        copy._pieces = tuple(pieces)
        return copy

    @property
    def held_back_m(self) -> float:
        """Distance over which nothing was taken out, because what was learnt cannot be a wheel's. [m]"""
        return float(self._progress["held_back_m"][0])

    @property
    def lengths_m(self) -> Floats:
        """Length of a turn of each wheel that is noisy at present. [m]"""
        return np.asarray(self._turns.length_m[self._turns.locked_m > 0])

    def cancel(self, s: Floats, yaw: Floats, x: Floats) -> None:
        """Take the noise out of blocks at odometers s and yaw (N,), anticlockwise: x (N, S, 3), in place. [m, rad, uT]

        In a bend, a wheel rolls less by the change of yaw times how far to the left of the middle it is.
        """
        before = [x[(s >= p.start_m) & (s < p.stop_m)] for p in self._pieces]
        self._follow(s, yaw, x)
        for piece, field in zip(self._pieces, before, strict=True):
            at = (s >= piece.start_m) & (s < piece.stop_m)
            x[at] = field - piece.turns.noise_ut(s[at]) if piece.turns else field

    def _follow(self, s: Floats, yaw: Floats, x: Floats) -> Floats:
        """Take out what is learnt on the way; the phases of the turns (N, W)."""
        phases = np.zeros((s.size, self._turns.references.size))
        if phases.size:
            _cancel(s, yaw, x, phases, self._turns, self._channels, self._limits, self._progress[0])
        return phases

    def learn_beginning(self, s: Floats, yaw: Floats, x: Floats) -> None:
        """Learn the noise of the first blocks of a recording (as for `cancel`), forwards and back; x stays as it is.

        Otherwise it is not known for the first metres, and strong wheels look like magnets there.
        """
        if not self._turns.references.size or not s.size:
            return
        self._estimate_errors(s, x)
        self.cancel(s, yaw, x.copy())
        self._reverse()
        self.cancel(-s[::-1], -yaw[::-1], x[::-1].copy())
        self._reverse()

    def _estimate_errors(self, s: Floats, x: Floats) -> None:
        """Set the deviations of the residuals by the median, in which the few blocks over magnets do not count."""
        median = np.median(abs(_without_offset(s, x)), axis=0)
        self._channels.error[:] = np.maximum(MEDIAN_DEVIATION * median, MIN_ERROR_UT)
        self._progress["errors_known"] = True

    def _reverse(self) -> None:
        """Go on in the opposite direction: the phases and distances change their signs, and with them all sines."""
        for part in (
            self._turns.phase,
            self._turns.rolled_m,
            self._turns.bank[:, 1],
            self._channels.weights[..., 1::2],
        ):
            part *= -1.0
        self._turns.pending_m[:] = 0.0
        self._turns.pending_ut_m[:] = 0.0
        self._progress["odometer_m"] *= -1.0
        self._progress["yaw_rad"] *= -1.0

    def constant_turns(self, s: Floats, yaw: Floats, x: Floats) -> list[ConstantTurns]:
        """Noise that a stretch of road can have in every turn, that of which most turns are alike first.

        A wheel's noise is the same in all turns, those before a line and after it included; a line begins and ends. So
        the turns that are alike but for the chips' noise are searched, from a few of them on, and the harmonics are
        fitted to these alone.

        Parameters
        ----------
        s, yaw, x
            Blocks of the stretch, as for `cancel`; they stay as they are. [m, rad, uT]
        """
        phases = np.unwrap(deepcopy(self)._follow(s, yaw, x.copy()), axis=0)
        if not phases.size or phases[-1, 0] - phases[0, 0] < 2 * math.pi * (3 * FIRST_TURNS):
            return []
        field = _without_offset(s, x)
        variance = np.median(abs(np.diff(field, axis=0)), axis=0) ** 2 * (MEDIAN_DEVIATION**2 / 2)
        near, references = self._channels.near, self._turns.references
        turn = np.maximum.accumulate(((phases[:, 0] - phases[0, 0]) / (2 * math.pi)).astype(np.int64))
        turn = np.unique(turn, return_inverse=True)[1]
        turns = _fourier_turns(phases, field / np.sqrt(np.maximum(variance, MIN_VARIANCE_UT2)), near, turn)
        turns[:, references] = 0.0
        alike: list[Bools] = []
        for first in _first_turns(turns):
            same = _alike(turns, first, 3 * (len(near) - references.size))
            if not any((same & other).sum() > SAME_SHARE * (same | other).sum() for other in alike):
                alike.append(same)
        found = []
        for same in sorted(alike, key=lambda one: -int(one.sum())):
            here = np.append(same, False)[turn]
            weights = _fit_turns(phases[here], field[here], variance, near, references)
            found.append(ConstantTurns(s, phases, weights))
        return found


def _without_offset(s: Floats, x: Floats) -> Floats:
    """Field less its moving mean over `SMOOTH_M`."""
    from scipy.ndimage import uniform_filter1d  # takes memory, and streams do not need it

    blocks = math.ceil(SMOOTH_M / max(float(s[-1] - s[0]) / s.size, MIN_STEP_M))
    return np.asarray(x - uniform_filter1d(x, blocks, axis=0))


def _regressors(phases: Floats) -> Floats:
    """Cosine and sine of each harmonic, wheel by wheel, at phases (N, W): shape (N, 2 W HARMONICS)."""
    angles = phases[:, :, None] * np.arange(1, HARMONICS + 1)
    return np.stack([np.cos(angles), np.sin(angles)], axis=3).reshape(len(phases), 2 * HARMONICS * phases.shape[1])


def _fourier_turns(phases: Floats, x: Floats, near: Floats, turn: Ints) -> Floats:
    """Fourier series of x (N, S, 3), in deviations, over each turn, in the phases of the wheel nearest to each sensor.

    The result has the shape (T, S, 3, 2 HARMONICS); each value has the variance 1 where there is nothing but noise. A
    turn at the end that is not complete is left out.
    """
    starts = np.flatnonzero(np.diff(turn, prepend=-1))
    count = np.diff(np.append(starts, turn.size))
    out = np.zeros((starts.size, *x.shape[1:], 2 * HARMONICS))
    for w in range(phases.shape[1]):
        sensors = np.flatnonzero(near.argmax(axis=1) == w)
        regressors = _regressors(phases[:, w : w + 1])
        for k in range(2 * HARMONICS):
            out[..., k][:, sensors] = np.add.reduceat(regressors[:, k, None, None] * x[:, sensors], starts, axis=0)
    return out[:-1] * np.sqrt(2 / count[:-1, None, None, None])


def _first_turns(turns: Floats) -> list[Bools]:
    """Few turns in a row from which on like ones are searched: those with the least energy, the first and the last.

    Magnets and iron add to the energy, but a line can be in opposite phase to a wheel for a while.
    """
    rows = turns.reshape(len(turns), -1)
    window = np.lib.stride_tricks.sliding_window_view(rows, FIRST_TURNS, axis=0)
    mean = window.mean(axis=2)
    energy = (mean**2).sum(axis=1) + window.var(axis=2, ddof=1).sum(axis=1)
    found = []
    for start in (int(np.argmin(energy)), 1, len(rows) - FIRST_TURNS - 1):
        of = np.zeros(len(rows), np.bool_)
        of[start : start + FIRST_TURNS] = True
        found.append(of)
    return found


def _alike(turns: Floats, first: Bools, channels: int) -> Bools:
    """Turns (T,) that differ from the mean of all such turns by no more than noise.

    The log likelihood ratio of a channel with more energy than noise, of its own size, is h (r - 1 - log r) for h
    harmonics and r times the energy of noise; of noise it has the mean h (log h - digamma(h)), about one half.
    """
    from scipy.special import digamma  # takes memory, and streams do not need it

    of_noise = channels * HARMONICS * (math.log(HARMONICS) - float(digamma(HARMONICS)))
    same = first
    for _ in range(MAX_ROUNDS):
        count = int(same.sum())
        energy = ((turns - turns[same].mean(axis=0)) ** 2).mean(axis=3)
        ratio = energy / np.where(same, 1 - 1 / count, 1 + 1 / count)[:, None, None]
        gain = HARMONICS * (ratio - 1 - np.log(np.maximum(ratio, 1e-9)))
        renewed = np.where(ratio > 0, gain, 0.0).sum(axis=(1, 2)) < of_noise + PRICE
        if renewed.sum() < MIN_TURNS or (renewed == same).all():
            break
        same = renewed
    return same


def _fit_turns(phases: Floats, x: Floats, variance: Floats, near: Floats, references: Ints) -> Floats:
    """Weights (S, 3, 2 W HARMONICS) by least squares, each wheel's shrunk by what it can have at a sensor.

    The variance of the weights at a wheel's reference follows from them; elsewhere it falls as in `_nearness`.
    """
    wheels = near.shape[1]
    regressors = _regressors(phases)
    normal = regressors.T @ regressors
    right = np.einsum("nk,nsa->ska", regressors, x)
    power = np.full(wheels, FIRST_POWER_UT2)
    weights = np.zeros((*x.shape[1:], regressors.shape[1]))
    for _ in range(POWER_ROUNDS):
        for j in range(len(near)):
            noise = float(variance[j].mean()) + MIN_VARIANCE_UT2
            expected = np.repeat(noise / (power * near[j] + 1e-9), 2 * HARMONICS)
            weights[j] = np.linalg.solve(normal + np.diag(expected), right[j]).T
        for w in range(wheels):
            own = weights[references[w], :, 2 * HARMONICS * w : 2 * HARMONICS * (w + 1)]
            power[w] = max(float((own**2).mean()), MIN_VARIANCE_UT2)
    return weights


def _nearness(positions_m: Floats, references: npt.NDArray[np.intp]) -> Floats:
    """How much of its noise a sensor can have from each wheel (S, W), 1 for the nearest.

    The energy of a dipole's field falls with the sixth power of the distance. Without this, two wheels with turns of
    the same length share what a sensor hears of one of them, and go wrong as soon as one gets ahead of the other.
    """
    if not len(references):
        return np.ones((len(positions_m), 0))
    apart = np.linalg.norm(positions_m[:, None] - positions_m[references], axis=2)
    energy = (apart + NEAR_M) ** -6.0
    return np.asarray(energy / energy.max(axis=1, keepdims=True))


def _wheel_limits(positions_m: Floats, references: npt.NDArray[np.intp]) -> _Limits:
    """How a wheel's noise falls away from its reference across the vehicle."""
    sensors = len(positions_m)
    rise = np.full(sensors, MAX_RISE_NEAR)
    beside = np.full((sensors, 2), -1, np.int64)
    if not len(references):
        return _Limits(rise, beside)
    across = np.abs(positions_m[:, None, 1] - positions_m[references, 1]).min(axis=1)
    rise = np.where(across >= FAR_M, MAX_RISE, MAX_RISE_NEAR)
    y = np.where(np.isin(np.arange(sensors), references), np.nan, positions_m[:, 1])  # of array sensors
    for j in np.flatnonzero(across >= NEAR_WHEEL_M):
        low, high = np.flatnonzero(y <= y[j] - APART_M), np.flatnonzero(y >= y[j] + APART_M)
        if low.size and high.size:
            beside[j] = low[np.argmax(y[low])], high[np.argmin(y[high])]
    return _Limits(rise, beside)


@kernel
def _cancel(
    s: Floats,
    yaw: Floats,
    x: Floats,
    phases: Floats,
    turns: _Turns,
    channels: _Channels,
    limits: _Limits,
    progress: _Progress,
) -> None:
    """Follow the turns, whose phases (N, W) are put out, take the noise out of each block and learn from the rest."""
    for i in range(s.size):
        phases[i] = turns.phase
        if not progress.has_begun:
            progress.has_begun = True
            progress.odometer_m = s[i]
            progress.yaw_rad = yaw[i]
            _track_offset(x[i], 1.0, channels)
            continue
        step = min(max(s[i] - progress.odometer_m, 0.0), MAX_STEP_M)
        progress.odometer_m = s[i]
        progress.driven_m += step
        if step <= 0:
            continue
        turned = yaw[i] - progress.yaw_rad
        progress.yaw_rad = yaw[i]
        _track_offset(x[i], min(step / min(OFFSET_M, FIRST_OFFSET_M + progress.driven_m), 1.0), channels)
        for w in range(turns.references.size):
            rolled_m = min(max(step - turns.left_m[w] * turned, 0.0), 2 * step)
            _follow_turn(w, rolled_m, progress.driven_m, x[i], turns, channels)
        phases[i] = turns.phase
        locked_m = turns.locked_m.max()
        if locked_m > 0:
            _set_gate(step, _strangeness(channels, limits), progress)
            fade = progress.gate * min(max((locked_m - FADE_AFTER_M) / FADE_M, 0.0), 1.0)
            outliers = _subtract_noise(x[i], step, fade, channels)
            if locked_m > FOLLOW_M:
                _steer(step, turns, channels)
            known = locked_m > START_M or progress.errors_known
            _learn(step, locked_m, outliers >= OUTLIER_CHANNELS and known, channels)


@routine
def _track_offset(x: Floats, rate: float, channels: _Channels) -> None:
    """Move each channel's offset towards a block (S, 3)."""
    for j in range(x.shape[0]):
        for axis in range(3):
            channels.offset[j, axis] += rate * (x[j, axis] - channels.offset[j, axis])


@routine
def _follow_turn(w: int, step: float, driven_m: float, x: Floats, turns: _Turns, channels: _Channels) -> None:
    """Advance a wheel's phase by what it rolled for a block (S, 3), and set its regressors: 0 unless it is noisy."""
    reference = turns.references[w]
    turns.rolled_m[w] += step
    turns.pending_m[w] += step
    for axis in range(3):
        turns.pending_ut_m[w, axis] += step * (x[reference, axis] - channels.offset[reference, axis])
    if turns.pending_m[w] > RENEW_M:
        _renew_length(w, turns.rolled_m[w] - turns.pending_m[w] / 2, turns)
        turns.pending_m[w] = 0.0
        turns.pending_ut_m[w, :] = 0.0
    turns.phase[w] = (turns.phase[w] + 2 * math.pi * step / turns.length_m[w]) % (2 * math.pi)
    noisy = turns.periodic[w] > (STILL_PERIODIC if turns.locked_m[w] > 0 else MIN_PERIODIC) and driven_m > START_M
    turns.locked_m[w] = turns.locked_m[w] + step if noisy else 0.0
    cosine, sine = (math.cos(turns.phase[w]), math.sin(turns.phase[w])) if noisy else (0.0, 0.0)
    cosine_h, sine_h = cosine, sine
    for h in range(HARMONICS):
        k = 2 * (w * HARMONICS + h)
        channels.regressors[k], channels.regressors[k + 1] = cosine_h, sine_h
        cosine_h, sine_h = cosine_h * cosine - sine_h * sine, sine_h * cosine + cosine_h * sine


@routine
def _renew_length(w: int, s: float, turns: _Turns) -> None:
    """Add the pending piece of a reference's signal to its bank, and find the length of a turn in it.

    The bank holds the first harmonics of a Fourier series for each trial length, forgetting over `BANK_M`.
    """
    pending_m, pending_ut_m = turns.pending_m[w], turns.pending_ut_m[w]
    bank, lengths = turns.bank[w], turns.lengths_m
    keep = math.exp(-pending_m / BANK_M)
    total = 1e-9
    for axis in range(3):
        turns.power[w, axis] = keep * turns.power[w, axis] + pending_ut_m[axis] ** 2 / pending_m
        total += turns.power[w, axis]
    _set_turns(s, turns)
    cosine, sine, cosine_h, sine_h, energy = turns.trials
    cosine_h[:], sine_h[:], energy[:] = cosine, sine, 0.0
    for h in range(bank.shape[1]):
        for axis in range(3):
            piece, real, imaginary = pending_ut_m[axis], bank[0, h, axis], bank[1, h, axis]
            for c in range(lengths.size):
                real[c] = keep * real[c] + piece * cosine_h[c]
                imaginary[c] = keep * imaginary[c] + piece * sine_h[c]
                energy[c] += real[c] * real[c] + imaginary[c] * imaginary[c]
        for c in range(lengths.size):
            cosine_h[c], sine_h[c] = (
                cosine_h[c] * cosine[c] - sine_h[c] * sine[c],
                sine_h[c] * cosine[c] + cosine_h[c] * sine[c],
            )
    at = int(np.argmax(energy))
    turns.length_m[w] = lengths[at]
    turns.periodic[w] = energy[at] / (bank.shape[1] * pending_m * total)
    if 0 < at < lengths.size - 1:  # the parabola through the best and its neighbours
        bend = energy[at - 1] - 2 * energy[at] + energy[at + 1]
        if bend < 0:
            turns.length_m[w] *= (lengths[1] / lengths[0]) ** (0.5 * (energy[at - 1] - energy[at + 1]) / bend)


@routine
def _set_turns(s: float, turns: _Turns) -> None:
    """Set cosine and sine of the turn at an odometer for each trial length.

    They are computed by the series of an eighth of the angle, which vectorises, and doubled three times: error 1e-10.
    """
    cosine, sine = turns.trials.cosine, turns.trials.sine
    for c in range(cosine.size):
        turn = s / turns.lengths_m[c]
        angle = (turn - math.floor(turn + 0.5)) * (math.pi / 4)
        a2 = angle * angle
        x = 1 - a2 / 2 * (1 - a2 / 12 * (1 - a2 / 30 * (1 - a2 / 56)))
        y = angle * (1 - a2 / 6 * (1 - a2 / 20 * (1 - a2 / 42 * (1 - a2 / 72))))
        for _ in range(3):
            x, y = x * x - y * y, 2 * x * y
        cosine[c], sine[c] = x, y


@routine
def _strength(j: int, channels: _Channels) -> float:
    """Strength of the noise at a sensor. [uT2]"""
    total: float = channels.strength[j, 0] + channels.strength[j, 1] + channels.strength[j, 2]
    return total


@routine
def _strangeness(channels: _Channels, limits: _Limits) -> float:
    """Strength of the noise at a sensor over the most that a wheel can have there, at the sensor with the highest."""
    highest = 0.0
    for j in range(channels.strength.shape[0]):
        error = channels.error[j]
        low, high = limits.beside[j]
        if low < 0:
            continue
        most = limits.rise[j] * (_strength(low, channels) + _strength(high, channels))
        least = MIN_STRANGE * (error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
        highest = max(highest, _strength(j, channels) / max(most, least))
    return highest


@routine
def _set_gate(step: float, strangeness: float, progress: _Progress) -> None:
    """Fade what is taken out, away while what was learnt cannot be a wheel's.

    It is then also of the magnets of a line, as far apart as a turn is long.
    """
    if progress.is_strange:
        progress.held_back_m += step
    if strangeness > 1:
        progress.is_strange = True
    elif strangeness < GATE_OPENS:
        progress.is_strange = False
    move = -step / GATE_M if progress.is_strange else step / GATE_M
    progress.gate = min(max(progress.gate + move, 0.0), 1.0)


@routine
def _subtract_noise(x: Floats, step: float, fade: float, channels: _Channels) -> int:
    """Take the predicted noise out of a block (S, 3), less where it is weak; returns the channels that are far off."""
    share = min(step / STRENGTH_M, 1.0)
    outliers = 0
    for j in range(x.shape[0]):
        for axis in range(3):
            predicted = 0.0
            for k in range(channels.regressors.size):
                predicted += channels.weights[j, axis, k] * channels.regressors[k]
            residual = x[j, axis] - channels.offset[j, axis] - predicted
            channels.residual[j, axis] = residual
            outliers += abs(residual) > CLIP * channels.error[j, axis]
            channels.strength[j, axis] += share * (predicted * predicted - channels.strength[j, axis])
            ratio = channels.strength[j, axis] / (channels.error[j, axis] ** 2 + 1e-6)
            x[j, axis] -= fade * predicted * ratio / (ratio + HALF_GAIN)
    return outliers


@routine
def _steer(step: float, turns: _Turns, channels: _Channels) -> None:
    """Move the phase of each wheel by what is left of its noise at its reference, where magnets are weak."""
    harmonics = channels.regressors.size // (2 * turns.phase.size)
    for w in range(turns.phase.size):
        j = turns.references[w]
        along = information = 0.0
        for axis in range(3):
            slope = 0.0
            for h in range(harmonics):
                k = 2 * (w * harmonics + h)
                weights = channels.weights[j, axis]
                slope += (h + 1) * (weights[k + 1] * channels.regressors[k] - weights[k] * channels.regressors[k + 1])
            limit = CLIP * channels.error[j, axis]
            clipped = min(max(channels.residual[j, axis], -limit), limit)
            variance = channels.error[j, axis] ** 2 + 1e-6
            along += clipped * slope / variance
            information += slope * slope / variance
        turns.phase[w] += min(step / STEER_M, 0.5) * along / (information + 1.0)


@routine
def _learn(step: float, locked_m: float, over_magnet: bool, channels: _Channels) -> None:
    """Renew the residual's deviation, and the weights by least mean squares unless a magnet is passed."""
    gain = 2 * step / min(LEARN_M, FIRST_LEARN_M + LEARN_SLOPE * locked_m)
    follow = min(step / STRENGTH_M, 1.0) * (MAGNET_RATE if over_magnet else 1.0)
    clip = CLIP * (FIRST_CLIP if locked_m < FIRST_CLIP_M else 1.0)
    for j in range(channels.error.shape[0]):
        for axis in range(3):
            limit = clip * channels.error[j, axis]
            clipped = min(max(channels.residual[j, axis], -limit), limit)
            channels.error[j, axis] += follow * (MEAN_DEVIATION * abs(clipped) - channels.error[j, axis])
            if not over_magnet:
                for w in range(channels.near.shape[1]):
                    move = gain * channels.near[j, w] * clipped
                    for k in range(2 * HARMONICS * w, 2 * HARMONICS * (w + 1)):
                        channels.weights[j, axis, k] += move * channels.regressors[k]

"""The default decoder (``method="matched"``): matched filters over all sensors and axes, then a fit of dipoles.

The stages in order: `preprocess`, `wheel_noise`, `matched_filter` (candidates), `detect_dipoles` (with `fit_window` and
`dipole_fit`), `classify` (also the assembly of tags and lines, with `identify`). `readings` has the results.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from copy import deepcopy
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from app.decoders.magnet.classify import (
    FORGET_M,
    POLE_ENERGY,
    Accepted,
    Classification,
    MagnetState,
    Rejected,
    TagAssembler,
    classify_dipoles,
    is_strong,
    shows_clearance,
    with_log_odds,
)
from app.decoders.magnet.detect_dipoles import DipoleDetector, are_same
from app.decoders.magnet.fit_window import WINDOW_M, Dipole, Region, SensorArray
from app.decoders.magnet.identify import TagCandidates
from app.decoders.magnet.matched_filter import (
    BIN_M,
    HALF_BINS,
    MAX_REGION_BINS,
    QUIET_BINS,
    REGION_BINS,
    REGION_END_BINS,
    REGION_OPEN,
    BinScores,
    make_filter_bank,
    scan_bins,
)
from app.decoders.magnet.preprocess import Blocks, FieldBins, Preprocessor
from app.decoders.magnet.readings import (
    Finding,
    LineCrossing,
    MagnetReading,
    NoiseFinding,
    NoiseKind,
    PlacedMagnet,
    TagReading,
    VehiclePath,
)
from app.decoders.magnet.wheel_noise import Piece, WheelNoiseCanceller
from app.markers.magnet import MOMENT_AM2
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace
from app.values import Floats

VERSION = "matched-9"
"""Kept with every decode; to be raised when findings change."""
FIRST_VARIANCE = 2.0
"""Variance of the matched filters' noise that is assumed at first. [uT2] Source: a chip's noise of 1.5 uT."""
REGION_MARGIN_BINS = 4
"""Bins before and after those above the threshold that belong to a region."""
SPARE_BINS = 40
"""Bins that are kept longer than any region needs them: 2 m."""
FORGET_SCORES = 400
"""Bins after which old scores are dropped. Speed only."""
FIT_SHARE, PLACE_STD_M, STAMP_STD_S = 0.8, 0.0045, 0.0003
"""Terms of the standard error of a place along the drive: the fit's own, times a factor because it allows for errors of
the field model; errors of magnet and sensor places; and the time of a sample, as axes are converted one after the
other. [1, m, s] Source: 300 scenes of `benchmarks.hunt.magnet` (seeds 62000 ff.); on others (`python -m benchmarks.hunt
magnet --seed 52000 --scenes 232`) 96.7 % are within two standard errors."""
OF_MAGNETS = (TagReading, LineCrossing)
"""Findings that follow from several magnets."""
CHUNK_SAMPLES = 4096
"""Samples of a whole trace that are decoded at a time. Bounds the memory."""
BEGINNING_M = 60.0
"""Distance of a whole trace from which the noise of the wheels is learnt first. [m] Source: that over which it is
learnt (`app.decoders.magnet.wheel_noise.LEARN_M`)."""


PIECE_M, AROUND_M = 240.0, 60.0
"""Pieces of the road for which explanations of the wheels' noise are compared, and the road before and after that is
decoded with one. [m] Source: a hundred turns, and `BEGINNING_M`."""
ROAD_STEP = 25  # [blocks] of which one odometer is kept: half a metre
MIN_ROW, TURN_ERROR, ROW_WIDTH_M, MAX_ROW_STEP_M = 4, 0.02, 0.2, 5.0
"""Dipoles in a row at one or two turns of a wheel, from which on they may be a line that was learnt, or a wheel; share
of a turn by which they may be off, distance across, and longest step. [1, 1, m, m] Source: of lines that are 2 % off,
magnets were lost at 33 cm, of those 2.5 % off few (decision 0029)."""


NO_MAGNET_WEIGHT = 5.0
"""[1] of energy that no magnet explains, against that of magnets. Source: where a line covers a whole recording, what
is left of magnets that were taken out is often another magnet (seeds 7701 and 9301 of lines of one turn at 33 cm)."""


MIN_GAIN = 1.2
"""[1] energy that another explanation must have over that of the learnt noise. Source: energies are in units of
each explanation's own noise, which differs by a seventh where they explain the same (a recording of the corpus); of
lines that were taken for wheels, the gain is two and more."""


class StrongDipole(NamedTuple):
    """Where a strong dipole lies, and the energy it explains: negative under the bar if it is no magnet, 0 beside."""

    odometer_m: float
    lateral_m: float
    explained: float


class MagnetDecoder:
    """Decodes a trace piece by piece; the findings do not depend on how it is cut.

    Parameters
    ----------
    bar : MagnetometerBar
        That recorded it.
    candidates : TagCandidates
        Tags that may be on the road.
    moment_am2 : float
        Of the magnets on the road. [A m2]
    state : MagnetState, optional
        What is known of clearance and moment before the trace; by default what the bar declares.
    wheels : WheelNoiseCanceller, optional
        That has learnt the noise of the wheels, as `learn_wheels` returns it; it is copied. By default the noise is
        learnt while the trace is decoded, and not known for the first metres.

    Attributes
    ----------
    state : MagnetState
        With what the magnets so far have shown.
    """

    def __init__(
        self,
        bar: MagnetometerBar,
        *,
        candidates: TagCandidates | None = None,
        moment_am2: float = MOMENT_AM2,
        state: MagnetState | None = None,
        wheels: WheelNoiseCanceller | None = None,
    ) -> None:
        self.bar = bar
        positions = bar.positions_m[bar.array].copy()
        self._middle_y = float(positions[:, 1].max() + positions[:, 1].min()) / 2
        self._path = VehiclePath(float(positions[:, 0].min()))
        positions[:, 0] -= positions[:, 0].min()
        positions[:, 2] -= np.median(positions[:, 2])
        self._array = SensorArray(positions, bar.array, bar.axis_delay_s)
        self._preprocessor = Preprocessor(bar)
        self._wheels = deepcopy(wheels) if wheels else WheelNoiseCanceller(bar.references, bar.positions_m)
        self._blocks = Blocks(bar.sensor_count)
        self._bins = FieldBins(positions)
        self._bank = make_filter_bank(positions)
        self._detector = DipoleDetector(self._bank, self._array)
        self.state = state or MagnetState(moment_am2, bar.clearance_m)
        self._assembler = TagAssembler(candidates or TagCandidates())
        self._variance = np.full((self._bank.taps.size, 3), FIRST_VARIANCE, np.float32)
        self._state = np.zeros(4, np.int64)  # of `scan_bins`
        self._next = HALF_BINS  # number of the next bin to score
        self._scores = BinScores.empty(0)
        self._score_start = HALF_BINS
        self._before: list[Dipole] = []  # of the last regions
        self._read: list[Dipole] = []  # those of them that were reported as magnets
        self._unplaced: list[MagnetReading] = []
        self._findings: list[Finding] = []

    def feed(self, chunk: MagnetTrace) -> list[Finding]:
        """Findings that a further piece of the trace completes, in the order of their completion."""
        self._preprocessor.feed(chunk)
        return self._advance(final=False)

    def finish(self) -> list[Finding]:
        """Findings that the end of the trace completes."""
        return self._advance(final=True)

    def _advance(self, *, final: bool) -> list[Finding]:
        count = self._blocks.s.size
        self._preprocessor.take(self._blocks, final=final)
        s, yaw, x = self._blocks.s[count:], self._blocks.yaw[count:], self._blocks.x[count:]
        self._take_out(s, self._blocks.t[count:], yaw, x)
        self._bins.append(s, np.ascontiguousarray(x[:, self.bar.array]))
        self._path.append(s, yaw)
        self._search(final)
        self._report_up_to(np.inf if final else (self._next - self._region_bins - 5) * BIN_M, final)
        self._forget()
        out, self._findings = self._findings, []
        return out

    @property
    def _region_bins(self) -> int:
        """Bins of the open region, 0 without one."""
        return int(self._state[REGION_BINS])

    def _take_out(self, s: Floats, t_s: Floats, yaw: Floats, x: Floats) -> None:
        """Take the wheels' noise out of new blocks, in place."""
        self._wheels.cancel(s, yaw, x)

    def _search(self, final: bool) -> None:
        """Score the bins that are complete, and detect the dipoles of each region that ends."""
        bins = self._bins
        stop = bins.start + bins.ready - HALF_BINS
        while self._next < stop:
            scores = BinScores.empty(stop - self._next)
            done = scan_bins(bins.x, self._next - bins.start, self._bank, self._variance, self._state, scores)
            self._scores = BinScores(
                np.concatenate((self._scores.statistic, scores.statistic[:done])),
                np.concatenate((self._scores.cell, scores.cell[:done])),
            )
            self._next += done
            quiet = self._state[QUIET_BINS] >= REGION_END_BINS or self._region_bins >= MAX_REGION_BINS
            if self._state[REGION_OPEN] and quiet:
                self._close_region()
        if final and self._state[REGION_OPEN]:
            self._close_region()

    def _close_region(self) -> None:
        """Detect and classify the dipoles of the open region."""
        length, quiet = self._region_bins, int(self._state[QUIET_BINS])
        self._state[REGION_OPEN:] = 0
        first = self._next - length - REGION_MARGIN_BINS
        last = self._next - quiet + REGION_MARGIN_BINS - 1
        self._report_up_to(first * BIN_M, final=False)
        region = self._make_region(first, last)
        prior = self.state.prior
        dipoles = with_log_odds(self._detector.detect(self._blocks, region, prior), prior)
        # a magnet at the border of two regions is detected in both: it is reported once, by the first that is sure
        dipoles = [d for d in dipoles if not any(are_same(d, read) for read in self._read)]
        self._before = [b for b in self._before if not any(are_same(b, d) for d in dipoles)]
        classes = self._classify(dipoles)
        keep_m = (region.start + HALF_BINS) * BIN_M - FORGET_M
        self._before = [d for d in (*self._before, *dipoles) if d.params[0] > keep_m]
        accepted = (d for d, c in zip(dipoles, classes, strict=True) if isinstance(c, Accepted))
        self._read = [d for d in (*self._read, *accepted) if d.params[0] > keep_m]
        for dipole, classification in zip(dipoles, classes, strict=True):
            reading = self._reading(dipole, classification)
            self._findings.append(reading)
            if isinstance(reading, MagnetReading):
                self._unplaced.append(reading)
            if is_strong(dipole, self._array.half_width_m):
                self.state.count_iron(dipole)
            if shows_clearance(dipole, prior, self._array.half_width_m) and not _is_iron(classification):
                self.state.learn(dipole, prior)
        self._assemble()

    def _classify(self, dipoles: list[Dipole]) -> list[Classification]:
        """Magnets and iron among the dipoles of a region."""
        return classify_dipoles(dipoles, self._before, self.state, self._array.half_width_m)

    def _make_region(self, first: int, last: int) -> Region:
        """The region of the bins first..last, as far as they are scored and kept."""
        bins = self._bins
        first = max(first, self._score_start, bins.start + HALF_BINS)
        last = min(last, self._next - 1)
        at = last - bins.start
        end_m = min((last + 1) * BIN_M + WINDOW_M, (self._next + HALF_BINS - 1) * BIN_M)
        return Region(
            x=bins.x[first - HALF_BINS - bins.start : at + HALF_BINS + 1],
            start=first - HALF_BINS,
            scores=self._scores.part(first - self._score_start, last + 1 - self._score_start),
            variance=self._variance,
            common_share=bins.common_share[at].copy(),
            loudness=bins.loudness[at],
            window_m=(first * BIN_M - WINDOW_M, end_m),
        )

    def _reading(self, dipole: Dipole, classification: Classification) -> MagnetReading | NoiseFinding:
        s, y, h = (float(p) for p in dipole.params[:3])
        t, v = (float(np.interp(s, self._blocks.s, values)) for values in (self._blocks.t, self._blocks.v))
        lateral_cm = 100 * (y - self._middle_y)
        if isinstance(classification, Rejected):
            return NoiseFinding(t, s, lateral_cm, classification.kind, classification.reason)
        m, fit_std_m = dipole.params[3:], math.sqrt(max(float(dipole.covariance[0, 0]), 0.0))
        return MagnetReading(
            t_s=t,
            odometer_m=s,
            lateral_cm=lateral_cm,
            polarity=classification.polarity,
            phi_deg=classification.orientation,
            confidence=classification.confidence,
            clearance_cm=100 * h,
            moment_am2=(float(m[0]), float(m[1]), float(m[2])),
            along_std_m=math.hypot(FIT_SHARE * fit_std_m, PLACE_STD_M, STAMP_STD_S * v),
            relative_std_m=fit_std_m,
            snr=float(np.sqrt(max(dipole.explained, 0.0))),
        )

    def _assemble(self) -> None:
        """Group the magnets up to where the path is known."""
        while self._unplaced and self._unplaced[0].odometer_m <= self._path.reach_m:
            magnet = self._unplaced.pop(0)
            position_m = self._path.position_m(magnet.odometer_m, magnet.lateral_cm / 100)
            self._findings += self._assembler.add(PlacedMagnet(magnet, position_m))

    def _report_up_to(self, until_m: float, final: bool) -> None:
        """Report what is complete because the search has come so far; the order is the road's."""
        gaps = self._preprocessor.findings
        while gaps and gaps[0].odometer_m < until_m:
            self._findings.append(gaps.pop(0))
        self._assemble()
        self._findings += self._assembler.finish() if final else self._assembler.pass_by(until_m)

    def _forget(self) -> None:
        keep = self._next - self._region_bins - 2 * HALF_BINS - SPARE_BINS
        self._bins.forget(keep)
        self._blocks.forget(keep * BIN_M)
        self._path.forget(min([keep * BIN_M, *(m.odometer_m - 1 for m in self._unplaced)]))
        drop = keep - self._score_start
        if drop > FORGET_SCORES:
            self._scores = BinScores(self._scores.statistic[drop:].copy(), self._scores.cell[drop:].copy())
            self._score_start += drop


def _is_iron(classification: Classification) -> bool:
    return isinstance(classification, Rejected) and classification.kind is NoiseKind.FERROUS


class _WholeDecoder(MagnetDecoder):
    """Decodes a whole trace, and keeps what shows how well its noise of the wheels was known."""

    def __init__(
        self,
        bar: MagnetometerBar,
        wheels: WheelNoiseCanceller,
        candidates: TagCandidates | None,
        state: MagnetState | None = None,
    ) -> None:
        super().__init__(bar, candidates=candidates, state=state, wheels=wheels)
        self._strong: list[StrongDipole] = []
        self._road: list[Floats] = []  # odometer and time (N, 2), about every half metre
        self._held_back: list[tuple[float, float]] = []  # stretches where the wheels' noise was not taken out
        self._turns: list[tuple[float, Floats]] = []  # odometer and the lengths of a turn of the noisy wheels

    def _take_out(self, s: Floats, t_s: Floats, yaw: Floats, x: Floats) -> None:
        held_back_m = self._wheels.held_back_m
        super()._take_out(s, t_s, yaw, x)
        if s.size:
            self._road.append(np.stack([s, t_s], 1)[::ROAD_STEP])
            self._turns.append((float(s[-1]), self._wheels.lengths_m))
            if self._wheels.held_back_m > held_back_m:
                self._held_back.append((float(s[0]), float(s[-1])))

    def _reading(self, dipole: Dipole, classification: Classification) -> MagnetReading | NoiseFinding:
        reading = super()._reading(dipole, classification)
        if dipole.explained >= POLE_ENERGY:
            sign = 1 if isinstance(reading, MagnetReading) else -int(is_strong(dipole, self._array.half_width_m))
            self._strong.append(StrongDipole(reading.odometer_m, reading.lateral_cm / 100, sign * dipole.explained))
        return reading

    @property
    def driven_m(self) -> float:
        """Distance so far. [m]"""
        return float(self._road[-1][-1, 0]) if self._road else 0.0

    def odometer_m(self, t_s: float) -> float:
        """Odometer at a time. [m]"""
        road = np.concatenate(self._road)
        return float(np.interp(t_s, road[:, 1], road[:, 0]))

    def time_s(self, odometer_m: float) -> float:
        """Time at an odometer; infinite beyond the road. [s]"""
        road = np.concatenate(self._road)
        return float(np.interp(odometer_m, road[:, 0], road[:, 1], -math.inf, math.inf))

    def explained(self, start_m: float, stop_m: float) -> tuple[float, float]:
        """Energy of the magnets in a piece of the road less that of what is none by its weight, and their share."""
        here = np.array([one.explained for one in self._strong if start_m <= one.odometer_m < stop_m])
        magnets, others = float(here[here > 0].sum()), float(-here[here < 0].sum())
        return magnets - NO_MAGNET_WEIGHT * others, magnets / max(magnets + others, POLE_ENERGY)

    def is_ambiguous(self, start_m: float, stop_m: float) -> bool:
        """Whether a line may have been taken for a wheel in a piece of the road, or a wheel for a line.

        So it is where noise was held back, or dipoles follow each other at one or two turns of a noisy wheel.
        """
        if any(first < stop_m and last >= start_m for first, last in self._held_back):
            return True
        row: list[tuple[StrongDipole, int]] = []
        for one in sorted(seen for seen in self._strong if start_m <= seen.odometer_m < stop_m):
            lengths = next((length for end, length in self._turns if end >= one.odometer_m), self._turns[-1][1])
            steps = np.array([lengths, 2 * lengths])
            row = [(before, n) for before, n in row if one.odometer_m - before.odometer_m < MAX_ROW_STEP_M]
            number = 1 + max(
                (
                    n
                    for before, n in row
                    if abs(one.lateral_m - before.lateral_m) < ROW_WIDTH_M
                    and (abs(one.odometer_m - before.odometer_m - steps) < TURN_ERROR * steps).any()
                ),
                default=0,
            )
            if number >= MIN_ROW:
                return True
            row.append((one, number))
        return False


def decode_trace(
    trace: MagnetTrace, bar: MagnetometerBar, *, candidates: TagCandidates | None = None, compare: bool = True
) -> list[Finding]:
    """Findings of a whole trace.

    It is decoded from its beginning again as soon as its magnets have shown the clearance, so that all of it is judged
    by that. Where they never do, no magnet is reported: iron would look like one at some clearance. Where a line may
    have been taken for a wheel, or a wheel for a line, other explanations are compared, and the likeliest is reported.
    """
    wheels = learn_wheels(trace, bar)
    found, decoder = _decode(trace, bar, wheels, candidates)
    others = [
        other
        for start_m, stop_m in (_ambiguous_pieces(decoder) if compare else [])
        if (other := _likeliest(trace, bar, candidates, decoder, start_m, stop_m)) is not None
    ]
    if others and others[0].piece.start_m == -math.inf and others[0].piece.stop_m == math.inf:
        found, decoder = others[0].found, others[0].decoder
    elif others:
        found, decoder = _decode(trace, bar, wheels.with_pieces([other.piece for other in others]), candidates)
    return found


def _decode(
    trace: MagnetTrace, bar: MagnetometerBar, wheels: WheelNoiseCanceller, candidates: TagCandidates | None = None
) -> tuple[list[Finding], _WholeDecoder]:
    """Findings of a trace with the clearance that it shows, and the decoder that found them."""
    decoder, found = _estimate(trace, bar, wheels, candidates)
    if not decoder.state.is_known:
        found = [_unsure(f) if isinstance(f, MagnetReading) else f for f in found if not isinstance(f, OF_MAGNETS)]
        return found, decoder
    decoder = _WholeDecoder(bar, wheels, candidates, decoder.state)
    found = [finding for chunk in _chunks(trace) for finding in decoder.feed(chunk)]
    return found + decoder.finish(), decoder


def _ambiguous_pieces(decoder: _WholeDecoder) -> list[tuple[float, float]]:
    """Pieces of the road where a line may have been taken for a wheel's noise, or the reverse. [m]"""
    count = max(round(decoder.driven_m / PIECE_M), 1)
    edges = [-math.inf, *(decoder.driven_m * k / count for k in range(1, count)), math.inf]
    return [piece for piece in pairwise(edges) if decoder.is_ambiguous(*piece)]


class _Explanation(NamedTuple):
    """Noise of the wheels over a piece of the road, and what was found with it."""

    piece: Piece
    found: list[Finding]
    decoder: _WholeDecoder


def _likeliest(
    trace: MagnetTrace,
    bar: MagnetometerBar,
    candidates: TagCandidates | None,
    decoder: _WholeDecoder,
    start_m: float,
    stop_m: float,
) -> _Explanation | None:
    """What explains a piece of the road better than the noise that was learnt on the way; None if nothing does.

    Compared are noise that is the same in every turn, as some turns show it, and no noise at all: by the energy that
    magnets explain, less that which none explains, which must be positive: what leaves that much is no explanation. The
    share of magnets must not fall: over iron alone, all energies fall where noise is left in. Where magnets explain
    all, nothing further is tried.
    """
    part = trace.between(decoder.time_s(start_m - AROUND_M), decoder.time_s(stop_m + AROUND_M))
    reach_m = decoder.odometer_m(float(part.t_s[0])) if start_m > -math.inf else 0.0
    wheels = learn_wheels(part, bar)
    front, blocks = Preprocessor(bar), Blocks(bar.sensor_count)
    front.feed(part)
    front.take(blocks, final=True)
    best, most = None, decoder.explained(start_m, stop_m)
    for turns in (*wheels.constant_turns(blocks.s, blocks.yaw, blocks.x), None):
        found, other = _decode(part, bar, wheels.with_pieces([Piece(-math.inf, math.inf, turns)]), candidates)
        explained = other.explained(start_m - reach_m, stop_m - reach_m)
        if explained[0] > max(MIN_GAIN * most[0], 0.0) and explained[1] >= most[1]:
            piece = Piece(start_m, stop_m, turns.moved(reach_m) if turns else None)
            best, most = _Explanation(piece, found, other), explained
            if most[1] == 1:
                break
    return best


def learn_wheels(trace: MagnetTrace, bar: MagnetometerBar) -> WheelNoiseCanceller:
    """The noise of the wheels, as the first `BEGINNING_M` of a whole trace show it, for a decoder that starts there."""
    wheels = WheelNoiseCanceller(bar.references, bar.positions_m)
    front, blocks = Preprocessor(bar), Blocks(bar.sensor_count)
    for chunk in _chunks(trace):
        front.feed(chunk)
        front.take(blocks)
        if blocks.s.size and blocks.s[-1] > BEGINNING_M:
            break
    near = blocks.s < BEGINNING_M
    wheels.learn_beginning(blocks.s[near], blocks.yaw[near], blocks.x[near])
    return wheels


def estimate_state(
    trace: MagnetTrace, bar: MagnetometerBar, wheels: WheelNoiseCanceller, candidates: TagCandidates | None = None
) -> tuple[MagnetState, list[Finding]]:
    """What the magnets of a trace share, and the findings up to where they have surely shown it."""
    decoder, found = _estimate(trace, bar, wheels, candidates)
    return decoder.state, found


def _estimate(
    trace: MagnetTrace, bar: MagnetometerBar, wheels: WheelNoiseCanceller, candidates: TagCandidates | None
) -> tuple[_WholeDecoder, list[Finding]]:
    """A decoder that has come to where the clearance is sure, or to the end, and its findings."""
    decoder = _WholeDecoder(bar, wheels, candidates)
    found: list[Finding] = []
    for chunk in _chunks(trace):
        found += decoder.feed(chunk)
        if decoder.state.is_sure:
            return decoder, found
    return decoder, found + decoder.finish()


def _chunks(trace: MagnetTrace) -> Iterator[MagnetTrace]:
    """A trace in pieces of `CHUNK_SAMPLES`."""
    starts = [-np.inf, *trace.t_s[CHUNK_SAMPLES::CHUNK_SAMPLES].tolist()]
    for start, end in zip(starts, [*starts[1:], np.inf], strict=True):
        yield trace.between(start, end)


def _unsure(magnet: MagnetReading) -> NoiseFinding:
    """A magnet of a recording that does not show the clearance."""
    reason = f"would be a magnet at a clearance of {magnet.clearance_cm:.0f} cm, but no three magnets show that it is"
    return NoiseFinding(magnet.t_s, magnet.odometer_m, magnet.lateral_cm, NoiseKind.UNKNOWN_CLEARANCE, reason)

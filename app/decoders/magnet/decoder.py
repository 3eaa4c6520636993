"""The default decoder (``method="matched"``): matched filters over all sensors and axes, then a fit of dipoles."""

from __future__ import annotations

import numpy as np

from app.decoders.magnet.assemble import Assembler, PlacedMagnet
from app.decoders.magnet.bins import Bins
from app.decoders.magnet.book import TagBook
from app.decoders.magnet.front import Blocks, FrontEnd
from app.decoders.magnet.iron import FORGET_M
from app.decoders.magnet.judge import ClearanceTracker, Verdict, is_sure, judge_region
from app.decoders.magnet.path import Path
from app.decoders.magnet.readings import Finding, MagnetReading, NoiseFinding
from app.decoders.magnet.region import RegionFitter
from app.decoders.magnet.search import BIN_M, HALF_BINS, HOLE_BINS, MAX_BINS, make_search_bank, scan_bins
from app.decoders.magnet.wheels import WheelCanceller
from app.decoders.magnet.window import Dipole, Expectation
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace

VERSION = "matched-2"
MOMENT_AM2 = 2.47
"""METRO's N52 cuboid. [A m2]"""
_THRESHOLD = 32.0


class MagnetDecoder:
    """Decodes a trace piece by piece; the findings do not depend on how it is cut.

    Parameters
    ----------
    bar : MagnetometerBar
        That recorded it.
    book : TagBook
        Tags that may be on the road.
    moment_am2 : float
        Of the magnets on the road. [A m2]
    """

    def __init__(self, bar: MagnetometerBar, *, book: TagBook | None = None, moment_am2: float = MOMENT_AM2) -> None:
        self.bar = bar
        self._front = FrontEnd(bar)
        positions = bar.positions_m[bar.array].copy()
        positions[:, 2] -= np.median(positions[:, 2])
        self._middle_y = float(positions[:, 1].max() + positions[:, 1].min()) / 2
        self._half_width = float(positions[:, 1].max() - positions[:, 1].min()) / 2
        self._bins = Bins(positions)
        self._path = Path(float(positions[:, 0].min()))
        self._assembler = Assembler(book or TagBook())
        self._unplaced: list[MagnetReading] = []
        positions[:, 0] -= positions[:, 0].min()
        self._blocks = Blocks(bar.sensor_count)
        self._wheels = WheelCanceller(bar.references, bar.sensor_count)
        bank = make_search_bank(positions)
        self._bank = bank
        self._fitter = RegionFitter(bank, positions, bar.array, bar.axis_delay_s)
        self._clearance = ClearanceTracker(moment_am2)
        self._variance = np.full((bank.taps.size, 3), 2.0, np.float32)
        self._state = np.zeros(4, np.int64)  # of `scan_bins`
        self._next = HALF_BINS  # number of the next bin to score
        self._score = np.empty((0, 2), np.float32)
        self._cell = np.empty((0, 2), np.int64)
        self._score_start = HALF_BINS
        self._before: list[Dipole] = []  # of the last regions
        self._findings: list[Finding] = []

    def feed(self, chunk: MagnetTrace) -> list[Finding]:
        """Findings that a further piece of the trace completes, in the order of their completion."""
        self._front.feed(chunk)
        return self._advance(final=False)

    def finish(self) -> list[Finding]:
        """Findings that the end of the trace completes."""
        return self._advance(final=True)

    def _advance(self, *, final: bool) -> list[Finding]:
        count = self._blocks.s.size
        self._front.take(self._blocks, final=final)
        self._wheels.clean(self._blocks.s[count:], self._blocks.x[count:])
        self._bins.append(self._blocks.s[count:], self._blocks.x[count:][:, self.bar.array])
        self._path.append(self._blocks.s[count:], self._blocks.t[count:], self._front.headings, final=final)
        self._front.headings = np.empty((0, 2))
        self._search(final)
        self._pass(final)
        self._forget()
        out, self._findings = self._findings, []
        return out

    def _search(self, final: bool) -> None:
        bins, bank = self._bins, self._bank
        stop = bins.start + bins.ready - HALF_BINS
        while self._next < stop:
            at, n = self._next - bins.start, stop - self._next
            score, cell = np.empty((n, 2), np.float32), np.empty((n, 2), np.int64)
            done = scan_bins(
                bins.x, at, at + n, bank.kernels, bank.taps, bank.products, bank.first, bank.sensor, bank.distance,
                bank.geometry, self._variance, self._state, _THRESHOLD, score, cell,
            )  # fmt: skip
            self._score = np.concatenate((self._score, score[:done]))
            self._cell = np.concatenate((self._cell, cell[:done]))
            self._next += done
            if self._state[1] and (self._state[3] >= HOLE_BINS or self._state[2] >= MAX_BINS):
                self._close()
        if final and self._state[1]:
            self._close()

    def _close(self) -> None:
        length, quiet = int(self._state[2]), int(self._state[3])
        self._state[1:] = 0
        first, last = self._next - length - 4, self._next - quiet + 3
        self._pass(final=False, until_m=first * BIN_M)
        first = max(first, self._score_start, self._bins.start + HALF_BINS)
        last = min(last, self._next - 1)
        at = slice(first - self._score_start, last + 1 - self._score_start)
        expected = self._clearance.expected
        until_m = min((last + 1) * BIN_M + 1.6, (self._next + HALF_BINS - 1) * BIN_M)
        dipoles = self._fitter.fit(
            self._blocks, self._bins, first, last, self._score[at], self._cell[at], self._variance, expected,
            _THRESHOLD, until_m,
        )  # fmt: skip
        dipoles.sort(key=lambda d: float(d.params[0]))
        verdicts = judge_region(dipoles, self._before, expected, self._half_width)
        self._before = [d for d in (*self._before, *dipoles) if d.params[0] > first * BIN_M - FORGET_M]
        for dipole, verdict in zip(dipoles, verdicts, strict=True):
            reading = self._reading(dipole, verdict, expected)
            self._findings.append(reading)
            if isinstance(reading, MagnetReading):
                self._unplaced.append(reading)
        self._assemble()

    def _reading(self, dipole: Dipole, verdict: Verdict, expected: Expectation) -> MagnetReading | NoiseFinding:
        s, y, h = (float(p) for p in dipole.params[:3])
        t = float(np.interp(s, self._blocks.s, self._blocks.t))
        lateral = 100 * (y - self._middle_y)
        if len(verdict) == 2:
            return NoiseFinding(t, s, lateral, *verdict)
        orientation, polarity, confidence = verdict
        if is_sure(dipole, expected):
            self._clearance.learn(dipole)
        m = dipole.params[3:]
        return MagnetReading(
            t, s, lateral, polarity, orientation, confidence, 100 * h, (float(m[0]), float(m[1]), float(m[2])),
            float(np.sqrt(max(dipole.covariance[0, 0], 0.0))), float(np.sqrt(max(dipole.explained, 0.0))),
        )  # fmt: skip

    def _assemble(self) -> None:
        """Group the magnets up to where the path is known."""
        while self._unplaced and self._unplaced[0].odometer_m <= self._path.reach_m:
            magnet = self._unplaced.pop(0)
            place = self._path.place(magnet.odometer_m, magnet.lateral_cm / 100)
            self._findings += self._assembler.add(PlacedMagnet(magnet, place))

    def _pass(self, final: bool, until_m: float | None = None) -> None:
        """Report what is complete because the search has come so far; the order is the road's."""
        if until_m is None:
            until_m = np.inf if final else (self._next - int(self._state[2]) - 5) * BIN_M
        gaps = self._front.findings
        while gaps and gaps[0].odometer_m < until_m:
            self._findings.append(gaps.pop(0))
        self._assemble()
        self._findings += self._assembler.finish() if final else self._assembler.pass_by(until_m)

    def _forget(self) -> None:
        keep = self._next - int(self._state[2]) - 2 * HALF_BINS - 40
        self._bins.forget(keep)
        self._blocks.forget(keep * BIN_M)
        self._path.forget(min([keep * BIN_M, *(m.odometer_m - 1 for m in self._unplaced)]))
        drop = keep - self._score_start
        if drop > 400:
            self._score, self._cell = self._score[drop:].copy(), self._cell[drop:].copy()
            self._score_start += drop


def decode_trace(trace: MagnetTrace, bar: MagnetometerBar, *, book: TagBook | None = None) -> list[Finding]:
    """Findings of a whole trace."""
    decoder = MagnetDecoder(bar, book=book)
    found: list[Finding] = []
    step = 4096
    for i in range(0, len(trace.t_s), step):
        end = trace.t_s[i + step] if i + step < len(trace.t_s) else np.inf
        found += decoder.feed(trace.between(trace.t_s[i] if i else -np.inf, end))
    return found + decoder.finish()

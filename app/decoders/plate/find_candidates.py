"""What may be a plate in a frame: quadruples of markers whose colours and grid make a fit worth its time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from app.decoders.plate.colour import MarkerSignal, Planes, coarse_ratio_signal, difference_signal, ratio_signal
from app.decoders.plate.detect_quads import MarkerQuad, detect_marker_quads
from app.decoders.plate.filter_candidates import MIN_LOG_ODDS, candidate_log_odds, size_misfit
from app.markers.plate import SIZES, PlateGeometry

SIGNALS = (difference_signal, ratio_signal, coarse_ratio_signal)
"""Signals that are searched, one after the other until a plate is read. Source: decision record 0010."""
MAX_FITS = 5
"""[candidates] that are fitted for one signal. Source: chosen by hand, for speed."""
LOG_ODDS_RANGE = 4.0
"""[log odds] by which a candidate may miss the limit under the first geometry, so that the others are tried. Source:
chosen by hand, for speed: the colours are the same under all of them."""
SIZE_MISFIT_RANGE = (-0.4, 0.55)
"""[log] measured over usual size of the markers of a geometry that is tried. Source: chosen by hand; wear and blur
change the size of markers."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """Quadruple of markers that may be a plate's, the geometries under which it may, and the log odds of the first.

    The likeliest geometry is the first.
    """

    quad: MarkerQuad
    geometries: tuple[PlateGeometry, ...]
    log_odds: float


def find_candidates(
    planes: Planes, geometries: Sequence[PlateGeometry]
) -> Iterator[tuple[MarkerSignal, list[Candidate]]]:
    """Signals of a frame at half resolution, each with its candidates, the likeliest first."""
    for signal_of in SIGNALS:
        signal = signal_of(planes)
        yield signal, _likely_candidates(signal, detect_marker_quads(signal), geometries)


def _likely_candidates(
    signal: MarkerSignal, quads: Sequence[MarkerQuad], geometries: Sequence[PlateGeometry]
) -> list[Candidate]:
    """Candidates that are worth a fit, each with the geometries under which they are."""
    first = candidate_log_odds(signal, quads, geometries[0]) if quads else np.empty(0)
    near = [
        (quad, float(odds)) for quad, odds in zip(quads, first, strict=True) if odds >= MIN_LOG_ODDS - LOG_ODDS_RANGE
    ]
    if not near:
        return []
    log_odds = {g: candidate_log_odds(signal, [quad for quad, _odds in near], g) for g in geometries[1:]}
    log_odds[geometries[0]] = np.array([odds for _quad, odds in near])
    likely = []
    for k, (quad, _odds) in enumerate(near):
        possible = [g for g in possible_geometries(quad, geometries) if log_odds[g][k] >= MIN_LOG_ODDS]
        if possible:
            possible.sort(key=lambda g: -log_odds[g][k])
            likely.append(Candidate(quad, tuple(possible), float(log_odds[possible[0]][k])))
    return sorted(likely, key=lambda candidate: -candidate.log_odds)[:MAX_FITS]


def possible_geometries(quad: MarkerQuad, geometries: Sequence[PlateGeometry]) -> list[PlateGeometry]:
    """Geometries whose markers have about a candidate's size; 8 x 8 always.

    Stains make markers smaller, and blur makes them larger.
    """
    misfit = {g: size_misfit(quad, g) for g in geometries}
    possible = [g for g in geometries if SIZE_MISFIT_RANGE[0] < misfit[g] < SIZE_MISFIT_RANGE[1] or g.n == SIZES[0]]
    return possible or [min(geometries, key=lambda g: abs(misfit[g]))]

"""Evidence that adds up: one plate in several frames is one code.

The cost of a pattern of units in each frame is a quadratic form (`unit_likelihoods`), and so is their sum. The frames
see the same wear, dirt, light and blur, so that their errors are correlated: the sum counts as fewer frames than it
has. The prior of the codes counts once, because only the joint costs go through `decode_symbols`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.decoders.plate import Array
from app.decoders.plate.confirm import MAX_UNSEEN, confirm_frames
from app.decoders.plate.decode_symbols import MAX_CHECKED_ERROR, decode_word
from app.decoders.plate.evidence import PlateEvidence, read_evidence
from app.decoders.plate.marker_colours import MIN_MARGIN, find_wrong_colour
from app.decoders.plate.pose import with_pose
from app.decoders.plate.unit_likelihoods import (
    LARGE_UNIT_PX,
    MAX_LARGE_RESIDUAL,
    MAX_LEVEL_RESIDUAL,
    PATTERNS,
    UnitEvidence,
    level_residuals,
)
from app.decoders.plate.unit_patterns import cell_costs, minimize_pattern
from app.markers.plate import SIZES, PlateCode, code_cells
from app.markers.reading import PlateOutcome, PlateReading
from app.sensors.camera import Camera

CORRELATION = 0.6
"""[1] correlation of the errors of two frames of one plate: k frames count as k / (1 + 0.6 (k - 1)), at most 1.7.
Source: `python -m benchmarks.video` prints the median over pairs of frames, of the residuals of the true units,
whitened by the model: 0.4 to 0.8, more where units are large and compression is weak."""
MAX_ODD_UNITS = 0.1
"""[1] share of the units by which frames that show the same may differ. A grid that is off by a unit differs in half of
them."""
MAX_FRAMES = 16
"""[frames] of one plate that are added up, those with the largest units. More frames than that count as hardly more."""
OUT_OF_VIEW = PlateOutcome.FEWER_THAN_FOUR_VERTICES
"""Frames that show a part of the plate count only where no frame shows all of it."""
_COLOUR_OUTCOMES = (PlateOutcome.RED_MARKER_MISSING, PlateOutcome.GREEN_MARKER_MISSING)
RESOLVED_UNIT_PX = 6.0
"""[px] size of a unit from which on larger ones show no more of it."""
MISSING_SHARE = 0.5
"""[1] share of the nearer half of the frames that must lack a part of a plate for it to be missing."""
FIXED = 1e-4
"""[contrast] spread of the joint contrast, which is 1 by construction."""


def count_effective(frames: int) -> float:
    """Number of independent frames that correlated ones count as."""
    return frames / (1 + CORRELATION * (frames - 1))


def accumulate(evidence: Sequence[PlateEvidence]) -> PlateEvidence:
    """Joint evidence of frames that show the same plate.

    Parameters
    ----------
    evidence : sequence of PlateEvidence
        One or more, of one geometry.

    Returns
    -------
    PlateEvidence
        That of the frame if there is only one.
    """
    if len(evidence) == 1:
        return evidence[0]
    whole = [one for one in evidence if one.missing is None or one.missing[0] is not OUT_OF_VIEW] or evidence
    largest = max(whole, key=lambda one: one.extent_px)
    used = sorted(whole, key=lambda one: -one.unit_px)[:MAX_FRAMES]
    agreeing = _largest_agreement(used)
    if len(agreeing) > 1:
        used = agreeing  # a frame whose grid is displaced, or that compression has spoilt, agrees with no other
    near = used[: (len(used) + 1) // 2]  # damage that small units hide shows in large ones
    coloured = [one for one in whole if one.colours is not None] or near
    coloured = sorted(coloured, key=lambda one: -one.unit_px)[: (len(coloured) + 1) // 2]
    weights = count_effective(len(used)) / len(used)
    units = _joint_units([one.units for one in used], weights, used[0].unit_px)
    return replace(
        largest,
        units=units,
        explained=float(np.median([one.explained for one in near])),
        unit_px=max(one.unit_px for one in used),
        weakest_marker=float(np.median([one.weakest_marker for one in coloured])),
        missing=_usual_missing(coloured),
        frames=len(used),
        agreeing=len(agreeing),
        verification=None,  # of one frame alone
    )


def differing_units(one: UnitEvidence, other: UnitEvidence) -> float:
    """Share of the units that are dark in one of two frames only."""
    return float((one.dark != other.dark).mean())


def _largest_agreement(evidence: Sequence[PlateEvidence]) -> list[PlateEvidence]:
    """The most frames, counted by the size of their units, that show about the same units as one of them."""
    groups = (
        [one for one in evidence if differing_units(one.units, middle.units) <= MAX_ODD_UNITS] for middle in evidence
    )
    return max(groups, key=lambda group: sum(min(one.unit_px, RESOLVED_UNIT_PX) for one in group))


def read_accumulated(
    evidence: Sequence[PlateEvidence], codebook: Sequence[PlateCode], camera: Camera | None = None
) -> tuple[PlateReading, PlateEvidence]:
    """The reading that several frames give together, in the one that shows the plate largest; and their evidence."""
    joint = accumulate(evidence)
    extent = np.ptp(joint.corners_px, axis=0)
    reading = PlateReading(
        PlateOutcome.CELLS_UNDECODABLE,
        joint.corners_px,
        joint.corners_covariance_px2,
        geometry=joint.geometry,
        width_px=float(extent[0]),
        height_px=float(extent[1]),
    )
    reading, _decoded = read_evidence(reading, joint, codebook)
    return with_pose(reading, camera), joint


def _joint_units(units: Sequence[UnitEvidence], share: float, max_unit_px: float) -> UnitEvidence:
    """The sum of quadratic forms as one, whose contrast is 1; the frames with the largest units come first.

    The cost of a pattern x in a frame is (x - d)' A (x - d) + 2 (x - d)' b with A = c^2 W and b = c W r, where d is the
    frame's best pattern, c its contrast, W its weight and r its residual.
    """
    size = len(units[0].dark)
    weight, linear = np.zeros((size, size)), np.zeros(size)
    votes = np.zeros(size)
    for one in units:
        dark = one.dark.astype(float)
        form = share * one.contrast**2 * one.weight
        weight += form
        linear += share * one.contrast * (one.weight @ one.residual) - form @ dark
        votes += (2 * dark - 1) * np.diag(form)
    dark = (votes > 0).astype(float)
    # half the slope of the sum at a pattern x is weight x + linear, that of the joint form is weight times its residual
    residual = np.linalg.solve(weight, weight @ dark + linear)
    residual, contrast = minimize_pattern(weight, residual - dark, dark, 1.0, FIXED)
    costs = cell_costs(weight, residual, dark, contrast, PATTERNS)
    near = units[: (len(units) + 1) // 2]
    # what units differ by in all frames is theirs, the rest is noise
    levels = np.mean([one.residual / one.contrast - one.dark for one in near], axis=0)
    distance = level_residuals(levels, dark, 1.0)
    scale = MAX_LEVEL_RESIDUAL / MAX_LARGE_RESIDUAL if max_unit_px >= LARGE_UNIT_PX else 1.0
    outlier_ratio = float(np.median([one.outlier_ratio for one in near]))
    return UnitEvidence(
        cell_costs=costs - costs.min(axis=1, keepdims=True),
        best=np.argmin(costs, axis=1),
        dark=dark > 0.5,
        disputed=np.mean([one.disputed for one in near], axis=0) >= MISSING_SHARE,
        level_residual=np.median([one.level_residual for one in near], axis=0),
        damage=scale * float(distance.max()) * outlier_ratio,
        outlier_ratio=outlier_ratio,
        weight=weight,
        residual=residual,
        contrast=contrast,
        scatter=float(np.median([one.scatter for one in units])),
        gap=float(np.median([one.gap for one in units])),
        span=float(np.median([one.span for one in units])),
        veils=units[0].veils,
        risk_log_odds=np.mean([one.risk_log_odds for one in near], axis=0),
        veil_log_odds=units[0].veil_log_odds,
    )


def _usual_missing(evidence: Sequence[PlateEvidence]) -> tuple[PlateOutcome, str] | None:
    """What most of the frames lack; colours that are weak in each of them count together."""
    missing = Counter(one.missing for one in evidence if one.missing is not None)
    if sum(missing.values()) < MISSING_SHARE * len(evidence):
        return None
    usual = missing.most_common(1)[0][0]
    colours = [one.colours for one in evidence if one.colours is not None]
    if usual[0] not in _COLOUR_OUTCOMES or len(colours) < len(evidence):
        return usual
    # margins are in standard deviations of one frame's noise
    gain = math.sqrt(count_effective(len(colours)))
    joint = replace(
        colours[0],
        margins=gain * np.mean([one.margins for one in colours], axis=0),
        tints=np.mean([one.tints for one in colours], axis=0),
        cast=np.mean([one.cast for one in colours], axis=0),
        rest=float(np.median([one.rest for one in colours])),
        beside=float(np.median([one.beside for one in colours])),
    )
    return usual if joint.margins.min() < MIN_MARGIN else find_wrong_colour(joint)


# === Frames of a drive that are decoded apart: readings of one plate, found by the symbols that they show.


MIN_SAME_LOG_ODDS = math.log(100)
"""[log odds] from which two readings are of one plate: that both show the same symbols, against unrelated ones."""
MIN_SHOWN_LOG_ODDS = math.log(1e4)
"""[log odds] from which a frame shows the code of its plate, against random symbols."""


@dataclass(slots=True)
class _SeenSymbols:
    """Readings of one plate in frames in a row."""

    places: list[tuple[int, int]]  # of the frame, and of the reading in it
    readings: list[PlateReading]

    @property
    def scores(self) -> Array:
        """Joint log of 16 times the probability of each symbol, shape (cells, 16); as `count_effective` frames."""
        weight = count_effective(len(self.readings)) / len(self.readings)
        scores = np.array([one.symbols.scores for one in self.readings if one.symbols is not None])
        return _normalized(weight * scores.sum(axis=0))

    @property
    def code(self) -> PlateCode | None:
        """That one of its frames shows alone."""
        return next((one.code for one in self.readings if one.code is not None), None)


def confirm_drive(frames: Sequence[tuple[int, Sequence[PlateReading]]]) -> dict[int, list[PlateReading]]:
    """Readings that the frames of a drive give together, in the order in which they were taken.

    Parameters and result as of `confirm_frames`, whose rule for digits without a check comes first. Then the symbols of
    refused readings are added up, over the frames that show the same plate: by their probabilities, whatever their
    digits. A code with checks is returned where its error probability is below `MAX_CHECKED_ERROR`, or a frame shows it
    alone; in the frames that show it, that is whose own symbols are `MIN_SHOWN_LOG_ODDS` likelier than random ones.
    """
    changed = confirm_frames(frames)
    known = [(number, changed.get(number, list(readings))) for number, readings in frames]
    for seen in _follow_symbols(known):
        if len(seen.readings) < 2 or all(one.code is not None for one in seen.readings):
            continue
        found = _joint_code(seen)
        if found is None:
            continue
        code, confidence = found
        shown = [place for place, one in zip(seen.places, seen.readings, strict=True) if _shows_code(one, code)]
        numbers = tuple(known[frame][0] for frame, _place in shown)
        for frame, place in shown:
            number, readings = known[frame]
            if readings[place].code is None:
                readings[place] = replace(
                    readings[place], outcome=PlateOutcome.READ, code=code, likely_code=None, doubtful_cells=(),
                    confidence=confidence, reason="", frames=numbers,
                )  # fmt: skip
                changed[number] = readings
    return changed


def _shows_code(reading: PlateReading, code: PlateCode) -> bool:
    """Whether a frame's own symbols are likelier to be the code's than random."""
    assert reading.symbols is not None
    scores = reading.symbols.scores
    return float(scores[np.arange(len(scores)), code.symbols].sum()) >= MIN_SHOWN_LOG_ODDS


def _follow_symbols(frames: Sequence[tuple[int, Sequence[PlateReading]]]) -> list[_SeenSymbols]:
    """Readings with the same symbols in frames in a row."""
    found: list[_SeenSymbols] = []
    for frame, (_number, readings) in enumerate(frames):
        still = [seen for seen in found if 0 < frame - seen.places[-1][0] <= MAX_UNSEEN]
        for place, reading in enumerate(readings):
            if reading.symbols is None:
                continue
            odds = [(_same_log_odds(seen, reading), k) for k, seen in enumerate(still)]
            best = max(odds, default=(-math.inf, -1))
            if best[0] >= MIN_SAME_LOG_ODDS:
                seen = still.pop(best[1])
                seen.places.append((frame, place))
                seen.readings.append(reading)
            else:
                found.append(_SeenSymbols([(frame, place)], [reading]))
    return found


def _same_log_odds(seen: _SeenSymbols, reading: PlateReading) -> float:
    """Log odds that a reading shows the symbols of a plate, against unrelated ones."""
    assert reading.symbols is not None
    scores = seen.scores
    if scores.shape != reading.symbols.scores.shape:
        return -math.inf
    codes = seen.code, reading.code
    if codes[0] is not None and codes[1] is not None and codes[0].digits != codes[1].digits:
        return -math.inf
    return float(np.logaddexp.reduce(scores + reading.symbols.scores - math.log(16), axis=1).sum())


def _normalized(scores: Array) -> Array:
    """Scores whose exponentials are 16 times probabilities."""
    normalized: Array = scores - np.logaddexp.reduce(scores, axis=1, keepdims=True) + math.log(16)
    return normalized


def _joint_code(seen: _SeenSymbols) -> tuple[PlateCode, float] | None:
    """The code that a plate's frames show together, and its probability; None where they leave it open."""
    alone = [one for one in seen.readings if one.code is not None]
    if alone:
        code = alone[0].code
        assert code is not None
        return code, min(one.confidence for one in alone)
    scores, look_alikes = seen.scores, min(one.symbols.look_alikes for one in seen.readings if one.symbols is not None)
    n = next((n for n in SIZES if len(code_cells(n)) == len(scores)), None)
    word = None if n is None else decode_word(np.exp(scores) / 16, n)
    if word is None or word.confidence(look_alikes) < 1 - MAX_CHECKED_ERROR:
        return None
    return word.code, word.confidence(look_alikes)

"""Whether bar and units of a recording can be what was declared, and the mistake that is likely if not.

The mounting of the bar is compared first (`mounting`), and corrected where the recording decides it. Two invariants
are used for the rest. The horizontal field of the earth turns with the heading of the vehicle, whatever offsets the
sensors have: its size shows the unit, its sense and its phase the axes. And magnets are dipoles: a speed or a field
in a wrong unit distorts them, so that none is read, or all of them look much too weak or too strong at a wrong
clearance; in the right unit they are read, and look like the magnets that are sold.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from app.decoders.magnet.decoder import decode_trace
from app.decoders.magnet.identify import TagCandidates
from app.decoders.magnet.mounting import MAX_PHASE_DEG, MIRRORED, as_declared, check_mounting, turning_field
from app.decoders.magnet.readings import (
    CheckedRecording,
    Finding,
    LikelyMistake,
    MagnetReading,
    NoiseFinding,
    NoiseKind,
)
from app.markers.magnet import MOMENT_AM2
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace

SURE_CONFIDENCE = 0.99
"""[probability] of a magnet that counts."""
MIN_MAGNETS = 4
"""[magnets] that another declaration must give. A tag has three, and iron gives one now and then."""
USUAL_STRENGTH = (0.65, 1.25)
"""[nominal moment] Strengths that the magnets of a recording have. Source: drives of the scene hunter (decision 0014):
speeds that are 1.6 times too low make it 0.4 to 0.6, speeds that are 1.6 times too high 1.1 to 1.5."""
MIN_RATIO, MIN_SHARE = 4.0, 0.9
"""[1] Energy that the magnets of another declaration must explain, over that of the declared one: where few were
read, and where all are too weak or too strong. Source: the same drives; the right unit explains 0.93 to 5 times as
much as one that makes them too weak."""
MAX_REJECTED = 0.5
"""[1] Dipoles that are no magnets, over the sure magnets, from which on the declaration is checked."""
PIECE_S = 30.0
"""[s] of the piece of a recording, where the field changes most, that is decoded again: thirteen decodes take one to
three seconds of one core."""
CHANGE_BLOCK_S = 1.0
"""[s] of the blocks by whose changes that piece is found."""
SPEED_FACTORS = {
    "km/h where m/s was declared": 1 / 3.6, "mph where m/s was declared": 0.44704,
    "m/s where km/h was declared": 3.6, "mph where km/h was declared": 1.609344,
    "m/s where mph was declared": 1 / 0.44704, "km/h where mph was declared": 1 / 1.609344,
}  # fmt: skip
"""Speeds, over those that a wrong unit gives. Source: definitions of the units."""
FIELD_FACTORS = {"ten times as large": 10.0, "a tenth as large": 0.1, "100 times as large": 100.0}
"""Fields, over those that a wrong unit gives. Source: mG, uT, 10 nT and mT are powers of ten apart."""
AXES = {
    "FRD where FLU was declared or the other way round (or a stream that runs backwards)": ((0, 1, 2), (1, -1, -1)),
    "that exchange x and y": ((1, 0, 2), (1, 1, 1)),
    "that exchange x and z": ((2, 1, 0), (1, 1, 1)),
    "that exchange y and z": ((0, 2, 1), (1, 1, 1)),
}
"""Axis that each vehicle axis is taken from, and its sign."""
EARTH_HORIZONTAL_UT = (8.0, 60.0)
"""[uT] amplitude with which the earth's horizontal field turns. Source: it is 10 to 42 uT below 65 degrees of latitude
(World Magnetic Model); a third of margin for the iron of a vehicle."""
CONTRADICTED_M = 0.06
"""[m] between the declared clearance and that of the magnets. Source: a load lowers a car by up to 5 cm."""


def decode_checked(
    trace: MagnetTrace, bar: MagnetometerBar, *, candidates: TagCandidates | None = None
) -> CheckedRecording:
    """Findings of a whole trace, decoded as its bar is mounted.

    Where the recording shows that the bar is not as declared, but not how it is, no magnet is reported.
    """
    check = check_mounting(trace, bar)
    if check.mounting is None:
        findings = decode_trace(trace, bar, candidates=candidates)
        refused = [_refused(one, check.faults[0]) for one in findings if isinstance(one, MagnetReading | NoiseFinding)]
        return CheckedRecording([*_notes(check.faults, trace), *refused], check.faults, trace, True)
    mounted = as_declared(check.mounting, trace, bar) if check.faults else trace
    findings = decode_trace(mounted, bar, candidates=candidates)
    return CheckedRecording([*_notes(check.faults, trace, "; corrected"), *findings], check.faults, mounted)


def _notes(faults: Sequence[LikelyMistake], trace: MagnetTrace, suffix: str = "") -> list[NoiseFinding]:
    """Faults of the bar as findings, at the beginning of the recording."""
    start_s = float(trace.t_s[0]) if len(trace.t_s) else 0.0
    return [NoiseFinding(start_s, 0.0, 0.0, NoiseKind.SENSOR, fault.reason + suffix) for fault in faults]


def _refused(one: MagnetReading | NoiseFinding, fault: LikelyMistake) -> NoiseFinding:
    """A magnet as the finding that its bar is not as declared."""
    if isinstance(one, NoiseFinding):
        return one
    reason = f"not reported, as the bar is not as declared: {fault.reason}"
    return NoiseFinding(one.t_s, one.odometer_m, one.lateral_cm, NoiseKind.SENSOR, reason)


def find_mistakes(
    trace: MagnetTrace,
    bar: MagnetometerBar,
    findings: Sequence[Finding],
    candidates: TagCandidates | None = None,
    depth_m: float = 0.0,
) -> list[LikelyMistake]:
    """Mistakes in units and axes that a recording shows.

    Parameters
    ----------
    trace : MagnetTrace
        As it was declared.
    findings : sequence of Finding
        What was read in it.
    candidates : TagCandidates, optional
        Tags that may be on the road.
    depth_m : float
        Of the magnets, which the clearance of the bar contains beside that above the road. [m]
    """
    mistakes = [mistake] if (mistake := compare_with_earth(trace, bar)) is not None else []
    sure = _sure(findings)
    rejected = sum(isinstance(one, NoiseFinding) and one.kind is not NoiseKind.GAP for one in findings)
    mistake = None
    if (
        len(sure) < MIN_MAGNETS
        or rejected > MAX_REJECTED * len(sure)
        or not _is_within(_strength(sure), USUAL_STRENGTH)
    ):
        mistake = compare_with_dipoles(trace, bar, candidates)
    if mistake is None and len(sure) >= MIN_MAGNETS:
        mistake = compare_with_clearance(sure, bar, depth_m)
    return [*mistakes, mistake] if mistake is not None else mistakes


def compare_with_clearance(
    magnets: Sequence[MagnetReading], bar: MagnetometerBar, depth_m: float = 0.0
) -> LikelyMistake | None:
    """The declared clearance, if sure magnets lie elsewhere."""
    if bar.clearance_m is None:
        return None
    seen_m = float(np.median([one.clearance_cm for one in magnets])) / 100
    if abs(seen_m - bar.clearance_m) < CONTRADICTED_M:
        return None
    return LikelyMistake(
        "bar.clearance_m",
        f"{len(magnets)} magnets lie {100 * seen_m:.0f} cm below the bar, {100 * bar.clearance_m:.0f} cm were declared",
        f"declare {seen_m - depth_m:.2f} m, or leave the clearance out",
    )


def compare_with_earth(trace: MagnetTrace, bar: MagnetometerBar) -> LikelyMistake | None:
    """The mistake that the earth's horizontal field shows while the vehicle turns, if there is one."""
    turning = turning_field(trace, bar)
    if turning is None:
        return None
    along, against = turning
    amplitude = max(abs(along), abs(against))
    if abs(against) > MIRRORED * abs(along):
        return LikelyMistake(
            "axes",
            "the earth's field turns against the heading",
            "the axes look like y right and z down where y left and z up was declared, or the other way round; "
            "declare the other of FRD and FLU",
        )
    phase_deg = float(np.degrees(np.angle(along)))
    if abs(phase_deg) > MAX_PHASE_DEG and abs(along) > MIRRORED * abs(against):
        turned = (
            "all signs look inverted" if abs(phase_deg) > 135 else f"the axes look turned by {phase_deg:.0f} degrees"
        )
        return LikelyMistake(
            "axes",
            f"the earth's field points {abs(phase_deg):.0f} degrees away from north",
            f"{turned}; declare the rotation of the sensors, or check the headings",
        )
    low, high = EARTH_HORIZONTAL_UT
    if not low <= amplitude <= high:
        return LikelyMistake(
            "unit",
            f"the field turns by {amplitude:.3g} uT with the vehicle, the earth's horizontal field is 10 to 42 uT",
            "check the unit of the field and the calibration of the sensors",
        )
    return None


def compare_with_dipoles(
    trace: MagnetTrace, bar: MagnetometerBar, candidates: TagCandidates | None = None
) -> LikelyMistake | None:
    """The unit or the axes with which a recording has magnets, where it has few or unlikely ones as it was declared.

    Magnets that are read in a wrong unit of the speed look too weak or too strong, all alike: then only a unit in which
    they are as strong as usual is reported.
    """
    piece = _most_changing_piece(trace, bar)
    declared = _sure_magnets(piece, bar, candidates)
    unlikely = len(declared) >= MIN_MAGNETS and not _is_within(_strength(declared), USUAL_STRENGTH)
    least = (MIN_SHARE if unlikely else MIN_RATIO) * _explained(declared)
    best, best_rank = None, (False, least)
    for field, what, changed in _alternatives(piece):
        if unlikely and field != "speed_unit":
            continue
        found = _sure_magnets(changed, bar, candidates)
        rank = (_is_within(_strength(found), USUAL_STRENGTH), _explained(found))
        if len(found) < MIN_MAGNETS or rank[1] < least or rank <= best_rank or (unlikely and not rank[0]):
            continue
        piece_text = f"the {PIECE_S:g} s in which the field changes most"
        reason = f"{piece_text} show {_describe(declared)} as declared, and {_describe(found)} with {what}"
        cure = f"check {field} of the declaration, and decode the recording again"
        best, best_rank = LikelyMistake(field, reason, cure), rank
    return best


def _describe(magnets: Sequence[MagnetReading]) -> str:
    """Their number and strength."""
    strength = f" of {_strength(magnets):.2f} times the nominal moment" if magnets else ""
    return f"{len(magnets)} magnet{'' if len(magnets) == 1 else 's'}{strength}"


def _alternatives(piece: MagnetTrace) -> Iterator[tuple[str, str, MagnetTrace]]:
    """Fields of the declaration, what they may have meant, and the recording as it would then be."""
    for name, factor in SPEED_FACTORS.items():
        yield "speed_unit", f"speeds in {name}", replace(piece, speed_m_s=piece.speed_m_s * factor)
    for name, factor in FIELD_FACTORS.items():
        yield "unit", f"a field that is {name}", replace(piece, field_ut=piece.field_ut * np.float32(factor))
    for name, (order, signs) in AXES.items():
        turned = np.ascontiguousarray(piece.field_ut[..., order] * np.array(signs, np.float32))
        yield "axes", f"axes {name}", replace(piece, field_ut=turned)


def _sure(findings: Sequence[Finding]) -> list[MagnetReading]:
    return [one for one in findings if isinstance(one, MagnetReading) and one.confidence > SURE_CONFIDENCE]


def _sure_magnets(trace: MagnetTrace, bar: MagnetometerBar, candidates: TagCandidates | None) -> list[MagnetReading]:
    return _sure(decode_trace(trace, bar, candidates=candidates, compare=False))


def _strength(magnets: Sequence[MagnetReading]) -> float:
    """Median of the moments, over the nominal one; 0 without magnets."""
    if not magnets:
        return 0.0
    return float(np.median([math.hypot(*one.moment_am2) for one in magnets])) / MOMENT_AM2


def _is_within(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= value <= limits[1]


def _explained(magnets: Sequence[MagnetReading]) -> float:
    """Energy of the field that the magnets explain, over the variance of the noise."""
    return sum(one.snr**2 for one in magnets)


def _most_changing_piece(trace: MagnetTrace, bar: MagnetometerBar) -> MagnetTrace:
    """The part of a recording in which the field changes most."""
    duration_s = float(trace.t_s[-1] - trace.t_s[0]) if len(trace.t_s) else 0.0
    if duration_s <= PIECE_S:
        return trace
    blocks = ((trace.t_s - trace.t_s[0]) / CHANGE_BLOCK_S).astype(int)
    change = np.nan_to_num(np.abs(np.diff(trace.field_ut[:, bar.array], axis=0)).max(axis=(1, 2)))
    strongest = np.zeros(int(blocks[-1]) + 1)
    np.maximum.at(strongest, blocks[1:], change)
    # magnets are many and alike, so one car that is passed slowly does not decide
    total = np.convolve(np.minimum(strongest, np.quantile(strongest, 0.99)), np.ones(int(PIECE_S)), mode="valid")
    start_s = float(trace.t_s[0]) + CHANGE_BLOCK_S * int(np.argmax(total))
    return trace.between(start_s, start_s + PIECE_S)

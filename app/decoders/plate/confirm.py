"""Tentative readings of one plate in several frames, confirmed by what all of the frames show together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.decoders.plate import Array
from app.markers.plate import PlateCode
from app.markers.reading import Certainty, PlateOutcome, PlateReading
from app.sensors.camera import Camera

# === How well pixels agree with a pattern of units, in one frame or in several.
#
# A server adds up frames, so nothing here is compiled.


CLEAN, STAINED, STAINED_SHARE = (1e-4, 1e-5), (0.1, 0.05), 0.02
"""[probability] of a smooth stain and of a spot on a unit of a clean and of a stained plate, and of a stained plate."""
OVERLAP = 4.0
"""[units] that share most of their pixels: the evidence of all units for stains counts one in so many."""


@dataclass(frozen=True, slots=True, eq=False)
class UnitVerification:
    """How well the pixels of one frame or of several agree with a pattern of units."""

    # shape (units, 5): of the pixels around each unit, in the order of the symbols' units: the unit as in the pattern,
    # flipped, the same two under a smooth stain, and flipped under a spot of paint
    log_likelihoods: Array

    @property
    def unit_errors(self) -> Array:
        """Probability that each unit is flipped, shape (units,)."""
        return _unit_errors(self.log_likelihoods)

    @property
    def error_probability(self) -> float:
        """Probability that any unit is flipped."""
        return float(-np.expm1(np.log1p(-np.minimum(self.unit_errors, 1 - 1e-12)).sum()))

    @property
    def cell_confidence(self) -> tuple[float, ...]:
        """Probability that all four units of each cell are right."""
        return tuple(float(p) for p in (1 - self.unit_errors).reshape(-1, 4).prod(axis=1))


def add_up(log_likelihoods: Sequence[Array]) -> UnitVerification:
    """What several frames of one plate show of one pattern together: log likelihoods are summed, priors count once."""
    return UnitVerification(np.sum(log_likelihoods, axis=0))


def _unit_errors(likelihoods: Array) -> Array:
    """Probability that each unit is flipped, from the log likelihoods of its hypotheses."""
    read, flipped, read_stained, flipped_stained, flipped_spot = likelihoods.T

    def under(stain: float, spot: float) -> tuple[float, Array]:
        as_read = np.logaddexp(math.log1p(-stain) + read, math.log(stain) + read_stained)
        other = np.logaddexp(math.log1p(-stain - spot) + flipped, math.log(stain) + flipped_stained)
        other = np.logaddexp(other, math.log(spot) + flipped_spot)
        return float(np.logaddexp(as_read, other).sum()), 1 / (1 + np.exp(np.clip(as_read - other, -700, 700)))

    clean_total, clean = under(*CLEAN)
    stained_total, stained = under(*STAINED)
    log_odds = math.log(STAINED_SHARE / (1 - STAINED_SHARE)) + (stained_total - clean_total) / OVERLAP
    share = 1 / (1 + math.exp(-min(max(log_odds, -700.0), 700.0)))
    return share * stained + (1 - share) * clean


UNCHECKED_CONFIDENCE = 0.99
"""[probability] that digits are right at most which neither Reed-Solomon checks nor the registry confirm: one plate in
fifty has something on it (`STAINED_SHARE`), and what covers one unit exactly cannot be seen. Source: spots on purpose
misread 44 of 80 plates (decision record 0011); 30 of the 40 changes of one unit make another digit."""


def with_unseen_damage(reading: PlateReading) -> PlateReading:
    """The reading with the probability that its digits are right although no check confirms them."""
    if reading.certainty is not Certainty.UNCHECKED:
        return reading
    return replace(reading, confidence=min(reading.confidence, UNCHECKED_CONFIDENCE))


# === Tentative readings of one plate in several frames, confirmed by what all of the frames show together.


MAX_JOINT_ERROR = 1e-5
"""[probability] of an error by the frames together, below which they confirm digits. Source: errors of the frames of
one plate are correlated, so the sum is overconfident; 62 of 120 stained drives in a trial, none of them wrong."""
SAME_VIEW = 1.05
"""[1] ratio of the heights of a plate's image up to which two frames show the same: a standing vehicle's repeat their
errors, and count as one."""
MAX_UNSEEN = 3
"""[frames] after which a plate that was not seen is another one."""
CLOSE_CELLS = 3
"""[cells] by which readings of one plate may differ. A stain covers one to three."""


@dataclass(slots=True)
class _Sightings:
    """One code in frames in a row: places of the frames, and of the readings in them."""

    code: PlateCode
    places: list[tuple[int, int]]

    @property
    def frames(self) -> set[int]:
        """Places of the frames."""
        return {frame for frame, _reading in self.places}


def confirm_frames(frames: Sequence[tuple[int, Sequence[PlateReading]]]) -> dict[int, list[PlateReading]]:
    """Tentative readings that other frames confirm.

    Parameters
    ----------
    frames : sequence of (int, sequence of PlateReading)
        Numbers of frames in the order in which they were taken, and what each shows alone.

    Returns
    -------
    dict of int to list of PlateReading
        By the number of the frame, the readings of frames of which one was confirmed.

    Notes
    -----
    Log likelihoods of the units' hypotheses are summed, the priors of stains and spots count once. Frames of the same
    view, as a standing vehicle takes them, count as one. Frames that show about the same digits, but not the same,
    confirm nothing: one of them is wrong, and a stain is in every frame. A sure reading alone confirms only those of
    frames that show the plate smaller: a larger view that is not sure of the digits shows what the small one did not.
    """
    changed: dict[int, list[PlateReading]] = {}
    for sightings in _find_sightings(frames):
        readings = [frames[frame][1][place] for frame, place in sightings.places]
        if all(one.code is not None for one in readings) or _is_contradicted(sightings, frames):
            continue
        error_probability = _joint_error(readings)
        if error_probability is None:
            continue
        numbers = tuple(frames[frame][0] for frame, _place in sightings.places)
        for (frame, place), reading in zip(sightings.places, readings, strict=True):
            if reading.code is None:
                number, shown = frames[frame]
                changed.setdefault(number, list(shown))[place] = _read(reading, error_probability, numbers)
    return changed


def _find_sightings(frames: Sequence[tuple[int, Sequence[PlateReading]]]) -> list[_Sightings]:
    found: list[_Sightings] = []
    latest: dict[PlateCode, _Sightings] = {}
    for frame, (_number, readings) in enumerate(frames):
        for place, reading in enumerate(readings):
            code = reading.code or reading.likely_code
            if code is None:
                continue
            known = latest.get(code)
            if known is None or frame - known.places[-1][0] > MAX_UNSEEN:
                known = latest[code] = _Sightings(code, [])
                found.append(known)
            known.places.append((frame, place))
    return found


def _is_contradicted(sightings: _Sightings, frames: Sequence[tuple[int, Sequence[PlateReading]]]) -> bool:
    """Whether a frame in between shows the plate with other digits."""
    first, last = sightings.places[0][0], sightings.places[-1][0]
    others = (frame for frame in range(first, last + 1) if frame not in sightings.frames)
    codes = (one.code or one.likely_code for frame in others for one in frames[frame][1])
    digits = sightings.code.digits
    return any(
        code is not None
        and len(code.digits) == len(digits)
        and sum(a != b for a, b in zip(code.digits, digits, strict=True)) <= CLOSE_CELLS
        for code in codes
    )


def _joint_error(readings: Sequence[PlateReading]) -> float | None:
    """Probability that the digits are wrong, by all frames together; None where these do not confirm them."""
    largest_px = max(one.height_px for one in readings)
    near = [1 - one.confidence for one in readings if one.code and SAME_VIEW * one.height_px >= largest_px]
    if near:
        return min(near)
    views = _views(readings)
    if len(views) < 2:
        return None
    error_probability = add_up(views).error_probability
    return error_probability if error_probability < MAX_JOINT_ERROR else None


def _views(readings: Sequence[PlateReading]) -> list[npt.NDArray[np.float64]]:
    """Log likelihoods of the units' hypotheses in each view, the mean of its frames."""
    views: list[list[npt.NDArray[np.float64]]] = []
    least_px = 0.0
    for one in sorted(readings, key=lambda reading: reading.height_px):
        if one.unit_log_likelihoods is None:
            continue
        if not views or one.height_px > SAME_VIEW * least_px:
            views.append([])
            least_px = one.height_px
        views[-1].append(one.unit_log_likelihoods)
    return [np.asarray(np.mean(view, axis=0)) for view in views]


def _read(reading: PlateReading, error_probability: float, frames: tuple[int, ...]) -> PlateReading:
    return with_unseen_damage(replace(
        reading, outcome=PlateOutcome.READ, code=reading.likely_code, likely_code=None, doubtful_cells=(),
        confidence=1 - error_probability, reason="", frames=frames,
    ))  # fmt: skip


# === Frames that should show a plate which frames beside them show.


MAX_EXPECTED = 6
"""[frames] before and after those that show a plate, in which it is expected."""
FRAME_ADVANCES_M, ADVANCE_HYPOTHESES = (0.1, 4.0), 24
"""[m] that a vehicle comes on between two frames, where no two of them show how much, and hypotheses in between. 10 m/s
at 100 Hz to 40 m/s at 10 Hz."""
ADVANCE_ERRORS = (0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3)
"""[1] ratios that are tried to the advance that other frames show."""
STANDING_M = 0.05
"""[m] advance from frame to frame below which a vehicle stands: another frame shows the same again."""


@dataclass(frozen=True, slots=True, eq=False)
class DriveFrame:
    """What a frame of a drive shows, in the order in which the frames were taken."""

    number: int
    readings: Sequence[PlateReading]
    camera: Camera | None


class Expected(NamedTuple):
    """A plate that another frame shows."""

    number: int  # of that frame
    reading: PlateReading  # as it shows it
    advances_m: tuple[float, ...]  # how far the vehicle may have come since


def list_expected(frames: Sequence[DriveFrame]) -> dict[int, list[Expected]]:
    """Plates that frames should show, because frames beside them do; by the number of the frame.

    The advance follows from two frames that show the plate; where only one does, it is open.
    """
    expected: dict[int, list[Expected]] = {}
    for seen in _list_seen(frames):
        places = np.array([place for place, _ahead_m, _reading in seen])
        for place in range(max(places[0] - MAX_EXPECTED, 0), min(places[-1] + MAX_EXPECTED + 1, len(frames))):
            if place in places:
                continue
            nearest = int(np.abs(places - place).argmin())
            advances_m = _advances_m(seen, place - int(places[nearest]))
            if advances_m:
                plate = Expected(frames[places[nearest]].number, seen[nearest][2], advances_m)
                expected.setdefault(frames[place].number, []).append(plate)
    return expected


def with_expected(readings: Sequence[PlateReading], found: Sequence[PlateReading]) -> list[PlateReading]:
    """Readings of a frame with the plates that were found where they are expected, in place of refused ones there."""
    sure = [one for one in readings if one.code is not None]
    new = [one for one in found if not any(one.is_at(other) for other in sure)]
    refused = [one for one in readings if one.code is None and not any(one.is_at(other) for other in new)]
    return [*sure, *new, *refused]


_SeenAhead = list[tuple[int, float, PlateReading]]


def _list_seen(frames: Sequence[DriveFrame]) -> list[_SeenAhead]:
    """Readings with digits of each plate, with its distance ahead [m], in frames in a row."""
    found: list[_SeenAhead] = []
    latest: dict[PlateCode, _SeenAhead] = {}
    for place, frame in enumerate(frames):
        for reading in frame.readings:
            if reading.code is None or reading.pose is None or frame.camera is None:
                continue
            ahead_m = float(frame.camera.camera_from_vehicle[:, 0] @ reading.pose.translation_m)
            known = latest.get(reading.code)
            if known is None or place - known[-1][0] > 2 * MAX_EXPECTED:
                known = latest[reading.code] = []
                found.append(known)
            known.append((place, ahead_m, reading))
    return found


def _advances_m(seen: _SeenAhead, frames: int) -> tuple[float, ...]:
    """How far the vehicle may have come in so many frames since the plate was seen; none where it stands. [m]"""
    first, last = seen[0], seen[-1]
    if last[0] > first[0]:
        step_m = (first[1] - last[1]) / (last[0] - first[0])
        return tuple(ratio * step_m * frames for ratio in ADVANCE_ERRORS) if abs(step_m) > STANDING_M else ()
    return tuple(float(frames * step_m) for step_m in np.geomspace(*FRAME_ADVANCES_M, ADVANCE_HYPOTHESES))

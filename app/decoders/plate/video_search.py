"""Plates in a video: a cheap search of every frame, the whole decoder where something looks like a plate.

The search works at half resolution, which a video has without a conversion, and keeps only what has the size of a
plate at its place on the road. What one plate shows in several frames adds up (`accumulate`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from app.decoders.plate.accumulate import MAX_ODD_UNITS, OUT_OF_VIEW, RESOLVED_UNIT_PX, read_accumulated
from app.decoders.plate.decode_symbols import MAX_DAMAGE
from app.decoders.plate.detect_blobs import planes_of
from app.decoders.plate.detect_quads import MarkerQuad
from app.decoders.plate.evidence import MIN_EXPLAINED_ALONE, PlateEvidence
from app.decoders.plate.find_candidates import find_candidates
from app.decoders.plate.follow_plate import is_large_enough, predict_corners, view_elsewhere
from app.decoders.plate.pose import locate_plate
from app.decoders.plate.reader import DEFAULT_GEOMETRIES, read_plates
from app.decoders.plate.unit_likelihoods import code_units
from app.markers.plate import SIDE_MM, PlateCode, PlateGeometry
from app.markers.reading import PlateOutcome, PlatePose, PlateReading
from app.sensors.camera import Camera
from app.values import JsonObject

# === Which candidates of successive frames are the same plate: its place on the road follows from the vehicle's speed.


MAX_UNSEEN_S = 0.8
"""[s] after which a plate that was not seen is not expected any more. At 10 m/s a plate passes in about 1 s."""
BEHIND_M = -2.0
"""[m] ahead of the camera, where a plate is out of view of any camera that looks forward."""
AHEAD_GATE_M, AHEAD_GATE_SHARE, LEFT_GATE_M, LEFT_GATE_SHARE = 0.5, 0.10, 0.35, 0.04
"""[m, 1] distance from the predicted place along and across up to which a candidate is the plate, and the same as a
share of its distance. Plates lie metres apart, and a pose from 16 rows is good to 5 %."""
MAX_SPEED_M_S = 90.0
"""[m/s] of a vehicle whose speed is not known. 324 km/h."""
MIN_FIT_ADVANCE_M = 1.0
"""[m] by which a plate must have come nearer for a speed to follow."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenPlate:
    """A candidate plate in one frame."""

    frame: int
    time_s: float  # [s] of the frame, from any moment on
    reading: PlateReading  # by this frame alone
    evidence: PlateEvidence | None
    pose: PlatePose | None  # also of a plate that was not read
    # `ahead_m`, `left_m`: [m] of the vehicle's reference point; NaN without a pose
    ahead_m: float = math.nan
    left_m: float = math.nan


def place_candidate(
    frame: int, time_s: float, reading: PlateReading, evidence: PlateEvidence | None, camera: Camera | None
) -> SeenPlate:
    """A candidate with its place on the road."""
    pose = reading.pose
    if pose is None and evidence is not None and camera is not None:
        pose = locate_plate(evidence.corners_px, evidence.corners_covariance_px2, evidence.geometry, camera)
    if pose is None or camera is None:
        return SeenPlate(frame, time_s, reading, evidence, None)
    ahead_m, left_m, _up = camera.camera_from_vehicle.T @ pose.translation_m + camera.position_vehicle_m
    return SeenPlate(frame, time_s, reading, evidence, pose, float(ahead_m), float(left_m))


@dataclass(slots=True)
class PlateTrack:
    """One plate over the frames in which it was seen."""

    seen: list[SeenPlate] = field(default_factory=list)  # in which it was found by its colours
    # of frames that were searched for it at its predicted place; None where it was not seen
    followed: dict[int, PlateEvidence | None] = field(default_factory=dict)

    @property
    def last(self) -> SeenPlate:
        """The newest sighting."""
        return self.seen[-1]

    @property
    def evidence(self) -> list[PlateEvidence]:
        """Of its frames, of the geometry that most of them have."""
        found = [*(seen.evidence for seen in self.seen), *self.followed.values()]
        known = [one for one in found if one is not None]
        if not known:
            return []
        sizes = [one.geometry for one in known]
        usual = max(set(sizes), key=lambda geometry: (sizes.count(geometry), -geometry.n, -geometry.side_mm))
        return [one for one in known if one.geometry == usual]

    @property
    def evidence_frames(self) -> tuple[int, ...]:
        """Frames that show it clearly enough to be evidence."""
        found = {seen.frame: seen.evidence for seen in self.seen} | self.followed
        return tuple(sorted(frame for frame, evidence in found.items() if evidence is not None))

    @property
    def has_one_code(self) -> bool:
        """Whether no two frames read different codes."""
        return len({seen.reading.code.digits for seen in self.seen if seen.reading.code is not None}) <= 1

    def speed_m_s(self) -> float | None:
        """Speed of the vehicle that its places show; None of a plate that has come hardly nearer."""
        times = np.array([seen.time_s for seen in self.seen])
        ahead = np.array([seen.ahead_m for seen in self.seen])
        if len(times) < 3 or ahead[0] - ahead[-1] < MIN_FIT_ADVANCE_M or times[-1] <= times[0]:
            return None
        # near places are better known: a pose's error grows about with the square of the distance
        slope = np.polyfit(times - times[0], ahead, 1, w=1 / np.maximum(ahead, 1.0) ** 2)[0]
        return float(min(max(-slope, 0.0), MAX_SPEED_M_S))


class PlateTracker:
    """Collects the sightings of each plate, frame by frame."""

    def __init__(self) -> None:
        self._open: list[PlateTrack] = []
        self._speed_m_s: float | None = None

    @property
    def open(self) -> Sequence[PlateTrack]:
        """Plates that may still be in view."""
        return self._open

    @property
    def expected(self) -> bool:
        """Whether a plate may still be in view."""
        return bool(self._open)

    @property
    def speed_m_s(self) -> float | None:
        """Speed that the last plates showed."""
        return self._speed_m_s

    def add(self, time_s: float, seen: Sequence[SeenPlate], speed_m_s: float | None = None) -> list[PlateTrack]:
        """Assign the candidates of a frame, and return the tracks that are complete.

        Parameters
        ----------
        time_s : float
            Of the frame. [s]
        speed_m_s : float, optional
            Of the vehicle, where it is known. [m/s]
        """
        done = self._close(time_s, speed_m_s)
        free = list(self._open)
        for one in sorted(seen, key=lambda candidate: -candidate.reading.confidence):
            if math.isnan(one.ahead_m):
                done.append(PlateTrack([one]))
                continue
            near = [(self._distance(track, one, speed_m_s), k) for k, track in enumerate(free)]
            best = min(near, default=(math.inf, -1))
            if best[0] <= 1.0:
                track = free.pop(best[1])
                track.seen.append(one)
                self._speed_m_s = track.speed_m_s() or self._speed_m_s
            else:
                self._open.append(PlateTrack([one]))
        return done

    def finish(self) -> list[PlateTrack]:
        """The tracks that are left at the end."""
        done, self._open = self._open, []
        return done

    def _close(self, time_s: float, speed_m_s: float | None) -> list[PlateTrack]:
        def is_over(track: PlateTrack) -> bool:
            unseen_s = time_s - track.last.time_s
            speed = speed_m_s or self._speed_m_s or 0.0
            return not 0 <= unseen_s <= MAX_UNSEEN_S or track.last.ahead_m - speed * unseen_s < BEHIND_M

        done = [track for track in self._open if is_over(track)]
        self._open = [track for track in self._open if not is_over(track)]
        return done

    def _distance(self, track: PlateTrack, one: SeenPlate, speed_m_s: float | None) -> float:
        """Distance from the predicted place, as a share of the gate."""
        last = track.last
        codes = last.reading.code, one.reading.code
        if codes[0] is not None and codes[1] is not None and codes[0].digits != codes[1].digits:
            return math.inf
        step_s = one.time_s - last.time_s
        along = AHEAD_GATE_M + AHEAD_GATE_SHARE * last.ahead_m
        across = LEFT_GATE_M + LEFT_GATE_SHARE * last.ahead_m
        speed = speed_m_s if speed_m_s is not None else track.speed_m_s() or self._speed_m_s
        moved = last.ahead_m - one.ahead_m
        if speed is None:
            off = max(-moved, moved - MAX_SPEED_M_S * step_s, 0.0)
        else:
            off = abs(moved - speed * step_s)
        return max(off / along, abs(last.left_m - one.left_m) / across)


# === Plates in a video.


SIZE_TOLERANCE = 1.8
"""[1] by which a candidate may differ from the sizes that plates have at its place: pitch of the body, slopes, and
markers that are not all found."""
MARKER_SPAN = 0.75
"""[plate] distance between the centres of the markers, 1 - a cell of 8 x 8. Source: layout of the plate."""
FRUITLESS = ((30, 3), (8, 2))
"""[frames] after so many decoded frames in a row without a plate, only every third or second one with candidates is
decoded. A plate is in 9 frames at 30 m/s and 30 Hz."""
STANDING_M_S, STANDING_STEP = 0.5, 10
"""[m/s, frames] a vehicle that stands sees the same plate again; every tenth frame is decoded."""
RECENT_FRAMES = 8
"""[frames] that are searched back for a plate that was found. At 25 m/s and 30 Hz the plate was 7 m further away then,
where a unit has 1 px."""
MIN_CLEAR_EXPLAINED, MIN_CLEAR_UNIT_PX = 0.85, 3.0
"""[1, px] share of variance and size of a unit from which on a plate is followed back."""
MAX_CORRECTED = 1
"""[cells] that a check may correct without a registry. Source: one wrong plate of 164 in compressed videos
(`python -m benchmarks.video --short --seed 101 --seeds 16 --crf 30`): compression spoils many units at once."""
Pixels = npt.NDArray[np.uint8]


class _RecentFrame:
    """A frame that is kept for a while; its pixels are converted when they are wanted."""

    def __init__(self, number: int, time_s: float, full: Callable[[], Pixels]) -> None:
        self.number, self.time_s = number, time_s
        self._full = full

    @cached_property
    def pixels(self) -> Pixels:
        return self._full()


@dataclass(frozen=True, slots=True)
class FoundPlate:
    """One plate of a video."""

    reading: PlateReading  # by all frames together, placed in the one that shows it largest
    seen: tuple[SeenPlate, ...]  # each frame; its reading has the joint code where the frame shows it
    alone: tuple[int, ...]  # frames that were read by themselves
    speed_m_s: float | None  # [m/s] of the vehicle, as the plate's places show it
    taken_back: tuple[str, ...] = ()  # digits that single frames showed and all together refused


class PlateVideoSearch:
    """Searches the frames of a video one after the other.

    Parameters
    ----------
    camera : Camera, optional
        Without it, evidence of several frames does not add up.
    thermal : bool
        Then every frame is decoded: there are no colours to search for.

    Attributes
    ----------
    decoded : int
        Frames that went through the whole decoder.
    """

    def __init__(
        self, camera: Camera | None = None, codebook: Sequence[PlateCode] = (),
        geometries: Sequence[PlateGeometry] = DEFAULT_GEOMETRIES, *, thermal: bool = False,
    ) -> None:  # fmt: skip
        self._camera, self._codebook = camera, tuple(codebook)
        self._options: JsonObject = {"camera": camera, "codebook": codebook, "thermal": thermal}
        self._geometries = tuple(geometries) or DEFAULT_GEOMETRIES
        self._options["geometries"] = self._geometries
        self._known = {code.digits for code in codebook}
        self._thermal = thermal
        self._tracker = PlateTracker()
        self._recent: deque[_RecentFrame] = deque(maxlen=RECENT_FRAMES)
        self._fruitless, self._waited = 0, 0
        self.decoded = 0

    @property
    def expects(self) -> bool:
        """Whether a plate may still be in view."""
        return self._tracker.expected

    def look(
        self, number: int, time_s: float, half: Callable[[], Pixels], full: Callable[[], Pixels],
        speed_m_s: float | None = None,
    ) -> list[FoundPlate]:  # fmt: skip
        """Search a frame, and return the plates that are out of view now.

        Parameters
        ----------
        time_s : float
            Of the frame. [s]
        half, full : callable
            Return its pixels at half and at full resolution, upright: blue, green, red; or grey levels.
        speed_m_s : float, optional
            Of the vehicle, where it is known. [m/s]
        """
        seen = []
        frame = _RecentFrame(number, time_s, full)
        if self._is_due(speed_m_s) and (self._thermal or self._tracker.expected or self._has_candidates(half())):
            self.decoded += 1
            self._waited = 0
            for reading, evidence in read_plates(frame.pixels, **self._options):
                seen.append(place_candidate(number, time_s, reading, evidence, self._camera))
            self._fruitless = 0 if any(one.evidence is not None for one in seen) else self._fruitless + 1
        done = self._tracker.add(time_s, seen, speed_m_s)
        for track in self._tracker.open:
            if track.last.frame == number and not self._thermal:
                self._follow_back(track, frame, speed_m_s or track.speed_m_s() or self._tracker.speed_m_s)
        self._recent.append(frame)
        return [self._found(track) for track in done]

    def finish(self) -> list[FoundPlate]:
        """The plates that are in view at the end."""
        return [self._found(track) for track in self._tracker.finish()]

    def _follow_back(self, track: PlateTrack, frame: _RecentFrame, speed_m_s: float | None) -> None:
        """Look for a plate where it was in the last frames, if they do not show it yet."""
        last, camera = track.last, self._camera
        if not speed_m_s or camera is None or not _is_clear(last):
            return
        assert last.evidence is not None
        assert last.pose is not None
        shown = {seen.frame for seen in track.seen}
        for earlier in self._recent:
            if earlier.number in shown or earlier.number in track.followed:
                continue
            advance_m = speed_m_s * (earlier.time_s - last.time_s)
            corners = predict_corners(last.pose, last.evidence.geometry, camera, advance_m)
            if corners is None or not is_large_enough(corners, last.evidence):
                continue
            view = view_elsewhere(last.evidence, frame.pixels, earlier.pixels, corners)
            track.followed[earlier.number] = view

    def _is_due(self, speed_m_s: float | None) -> bool:
        self._waited += 1
        speed = speed_m_s if speed_m_s is not None else self._tracker.speed_m_s
        if speed is not None and speed < STANDING_M_S and self._tracker.expected:
            return self._waited >= STANDING_STEP
        return self._waited >= next((step for count, step in FRUITLESS if self._fruitless >= count), 1)

    def _has_candidates(self, half: Pixels) -> bool:
        return any(
            self._fits_the_road(candidate.quad)
            for _signal, candidates in find_candidates(planes_of(half), self._geometries)
            for candidate in candidates
        )

    def _fits_the_road(self, quad: MarkerQuad) -> bool:
        """Whether a plate at this place on the road would be about as large in the image."""
        camera = self._camera
        if camera is None:
            return True
        x_px, y_px = quad.centroids_px.mean(axis=0)
        ray = camera.camera_from_vehicle.T @ (
            (x_px - camera.cx_px) / camera.fx_px, (y_px - camera.cy_px) / camera.fy_px, 1.0
        )  # fmt: skip
        if ray[2] > -0.01:
            return False  # at or above the horizon
        scale_m = camera.height_m / -ray[2]
        at = scale_m * ray
        # a square of 1 m there: extent across and along the line of sight
        distance_m = float(np.linalg.norm(at))
        across_px = camera.fx_px / max(scale_m, 0.1)
        along_px = across_px * camera.height_m / distance_m
        width_px, height_px = np.ptp(quad.centroids_px, axis=0) / MARKER_SPAN
        low_m, high_m = SIDE_MM[0] / 1000 / SIZE_TOLERANCE, SIDE_MM[1] / 1000 * SIZE_TOLERANCE
        return bool(low_m * along_px <= height_px + 2 and height_px <= high_m * across_px and
                    low_m * across_px <= width_px + 2 and width_px <= 1.5 * high_m * across_px)  # fmt: skip

    def _found(self, track: PlateTrack) -> FoundPlate:
        seen = [replace(one, reading=_without_guesses(one.reading)) for one in track.seen]
        alone = tuple(one.frame for one in seen if one.reading.code is not None)
        speed = track.speed_m_s()
        best = max((one.reading for one in seen), key=lambda r: (r.code is not None, r.confidence))
        evidence = track.evidence
        if len(evidence) < 2:
            return FoundPlate(best, tuple(seen), alone, speed)
        joint, together = read_accumulated(evidence, self._codebook, self._camera)
        joint = _without_guesses(joint)
        shown = {one.reading.code.digits for one in seen if one.reading.code is not None}
        if len(shown | ({joint.code.digits} if joint.code else set())) > 1:
            reason = "frames of the plate show different codes"
            refused = [replace(one, reading=_refused(one.reading, reason)) for one in seen]
            return FoundPlate(_refused(joint, reason), tuple(refused), (), speed, tuple(sorted(shown)))
        if joint.code is None:
            reason = joint.reason or "the frames together do not show the digits of one of them"
            kept = [
                one
                if one.reading.code is None or self._stands(one, together)
                else replace(one, reading=_refused(one.reading, reason))
                for one in seen
            ]
            alone = tuple(one.frame for one in kept if one.reading.code is not None)
            best = max((one.reading for one in kept), key=lambda r: (r.code is not None, r.confidence))
            taken_back = tuple(sorted(shown)) if len(alone) == 0 else ()
            return FoundPlate(best if best.code is not None else joint, tuple(kept), alone, speed, taken_back)
        joint = replace(joint, frames=track.evidence_frames, grade=best.grade)
        return FoundPlate(joint, tuple(_with_code(one, joint) for one in seen), alone, speed)

    def _stands(self, seen: SeenPlate, together: PlateEvidence) -> bool:
        """Whether one frame's code stays where all frames together are too unsure to give one.

        It does if a check or the registry confirms it, or if its units are so large that they hide no stain; else if
        the frames together show the same units, and no stain that small units hide.
        """
        code = seen.reading.code
        if code is None or seen.evidence is None:
            return False
        if code.scheme.corrects or code.digits in self._known or seen.evidence.verification is not None:
            return True
        if seen.evidence.unit_px >= RESOLVED_UNIT_PX:
            return True
        units = together.units
        return units.damage <= MAX_DAMAGE and tuple(units.best) == code.symbols


def _is_clear(seen: SeenPlate) -> bool:
    evidence = seen.evidence
    if evidence is None or seen.pose is None or (evidence.missing is not None and evidence.missing[0] is OUT_OF_VIEW):
        return False
    return evidence.explained >= MIN_CLEAR_EXPLAINED and evidence.unit_px >= MIN_CLEAR_UNIT_PX


def _without_guesses(reading: PlateReading) -> PlateReading:
    """The reading, or its refusal where a check had to correct more than a video's units allow."""
    if reading.code is None or reading.from_codebook or len(reading.corrected_cells) <= MAX_CORRECTED:
        return reading
    return _refused(reading, "more wrong cells than a check may correct in a video")


def _with_code(seen: SeenPlate, joint: PlateReading) -> SeenPlate:
    """A sighting with the joint code, if its own units agree with it about everywhere."""
    if seen.reading.code is not None or joint.code is None or not _shows(seen.evidence, joint.code):
        return seen
    reading = replace(
        seen.reading, outcome=PlateOutcome.READ, code=joint.code, confidence=joint.confidence,
        cell_confidence=joint.cell_confidence, corrected_cells=joint.corrected_cells,
        from_codebook=joint.from_codebook, is_registered=joint.is_registered, pose=seen.pose, reason="",
        frames=joint.frames, likely_code=None, doubtful_cells=(),
    )  # fmt: skip
    return replace(seen, reading=reading)


def _shows(evidence: PlateEvidence | None, code: PlateCode) -> bool:
    if evidence is None or evidence.geometry.n != code.n or evidence.missing is not None:
        return False
    odd = float((code_units(code) != evidence.units.dark).mean())
    return evidence.explained >= MIN_EXPLAINED_ALONE and odd <= MAX_ODD_UNITS


def _refused(reading: PlateReading, reason: str) -> PlateReading:
    return replace(
        reading, outcome=PlateOutcome.UNSURE, code=None, likely_code=None, doubtful_cells=(), pose=None, grade=None,
        reason=reason,
    )  # fmt: skip

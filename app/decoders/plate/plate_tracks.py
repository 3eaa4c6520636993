"""Which candidates of successive frames are the same plate: its place on the road follows from the vehicle's speed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from app.decoders.plate.evidence import PlateEvidence
from app.decoders.plate.pose import locate_plate
from app.markers.reading import PlatePose, PlateReading
from app.sensors.camera import Camera

MAX_UNSEEN_S = 0.8
"""[s] after which a plate that was not seen is not expected any more. Source: chosen by hand; at 10 m/s a plate passes
in about 1 s."""
BEHIND_M = -2.0
"""[m] ahead of the camera, where a plate is out of view of any camera that looks forward. Source: chosen by hand."""
AHEAD_GATE_M, AHEAD_GATE_SHARE, LEFT_GATE_M, LEFT_GATE_SHARE = 0.5, 0.10, 0.35, 0.04
"""[m, 1] distance from the predicted place along and across up to which a candidate is the plate, and the same as a
share of its distance. Source: chosen by hand: plates lie metres apart, and a pose from 16 rows is good to 5 %."""
MAX_SPEED_M_S = 90.0
"""[m/s] of a vehicle whose speed is not known. Source: chosen by hand, 324 km/h."""
MIN_FIT_ADVANCE_M = 1.0
"""[m] by which a plate must have come nearer for a speed to follow. Source: chosen by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenPlate:
    """A candidate plate in one frame.

    Attributes
    ----------
    frame : int
    time_s : float
        Of the frame, from any moment on. [s]
    reading : PlateReading
        By this frame alone.
    evidence : PlateEvidence or None
    pose : PlatePose or None
        Also of a plate that was not read.
    ahead_m, left_m : float
        Of the vehicle's reference point; NaN without a pose. [m]
    """

    frame: int
    time_s: float
    reading: PlateReading
    evidence: PlateEvidence | None
    pose: PlatePose | None
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
    """One plate over the frames in which it was seen.

    Attributes
    ----------
    seen : list of SeenPlate
        In which it was found by its colours.
    followed : dict of int to PlateEvidence or None
        Of frames that were searched for it at its predicted place; None where it was not seen.
    """

    seen: list[SeenPlate] = field(default_factory=list)
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
        seen : sequence of SeenPlate
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

"""Plates in a video: a cheap search of every frame, the whole decoder where something looks like a plate.

The search works at half resolution, which a video has without a conversion, and keeps only what has the size of a
plate at its place on the road. What one plate shows in several frames adds up (`accumulate`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from app.decoders.plate.accumulate import read_accumulated
from app.decoders.plate.colour import Planes, coarse_ratio_signal, difference_signal, planes_of, ratio_signal
from app.decoders.plate.detect_quads import MarkerQuad, detect_marker_quads
from app.decoders.plate.evidence import MIN_EXPLAINED_ALONE, PlateEvidence
from app.decoders.plate.plate_tracks import PlateTrack, PlateTracker, SeenPlate, place_candidate
from app.decoders.plate.reader import DEFAULT_GEOMETRIES, MAX_FITS, read_plates
from app.markers.plate import SIDE_MM, PlateCode, PlateGeometry, PlateScheme, unit_index
from app.markers.reading import PlateOutcome, PlateReading
from app.sensors.camera import Camera

SIZE_TOLERANCE = 1.8
"""[1] by which a candidate may differ from the sizes that plates have at its place: pitch of the body, slopes, and
markers that are not all found. Source: chosen by hand."""
MARKER_SPAN = 0.75
"""[plate] distance between the centres of the markers, 1 - a cell of 8 x 8. Source: layout of the plate."""
FRUITLESS = ((30, 3), (8, 2))
"""[frames] after so many decoded frames in a row without a plate, only every third or second one with candidates is
decoded. Source: chosen by hand; a plate is in 9 frames at 30 m/s and 30 Hz."""
STANDING_M_S, STANDING_STEP = 0.5, 10
"""[m/s, frames] a vehicle that stands sees the same plate again; every tenth frame is decoded. Source: by hand."""
MAX_ODD_UNITS = 0.1
"""[1] share of a frame's units that may differ from the joint code where the frame gives a pose for it. Source: chosen
by hand: a grid that is off by a unit differs in half of them."""
Pixels = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class FoundPlate:
    """One plate of a video.

    Attributes
    ----------
    reading : PlateReading
        By all frames together, placed in the one that shows it largest.
    seen : tuple of SeenPlate
        Each frame; its reading has the joint code where the frame shows it.
    alone : tuple of int
        Frames that were read by themselves.
    speed_m_s : float or None
        Of the vehicle, as the plate's places show it. [m/s]
    taken_back : tuple of str
        Digits that single frames showed and all together refused.
    """

    reading: PlateReading
    seen: tuple[SeenPlate, ...]
    alone: tuple[int, ...]
    speed_m_s: float | None
    taken_back: tuple[str, ...] = ()


class PlateVideoSearch:
    """Searches the frames of a video one after the other.

    Parameters
    ----------
    camera : Camera, optional
        Without it, evidence of several frames does not add up.
    codebook : sequence of PlateCode
    geometries : sequence of PlateGeometry
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
        self._options: dict[str, Any] = {"camera": camera, "codebook": codebook, "thermal": thermal}
        if geometries:
            self._options["geometries"] = tuple(geometries)
        self._known = {code.digits for code in codebook}
        self._thermal = thermal
        self._tracker = PlateTracker()
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
        number : int
        time_s : float
            Of the frame. [s]
        half, full : callable
            Return its pixels at half and at full resolution, upright: blue, green, red; or grey levels.
        speed_m_s : float, optional
            Of the vehicle, where it is known. [m/s]
        """
        seen = []
        if self._is_due(speed_m_s) and (self._thermal or self._tracker.expected or self._has_candidates(half())):
            self.decoded += 1
            self._waited = 0
            for reading, evidence in read_plates(full(), **self._options):
                seen.append(place_candidate(number, time_s, reading, evidence, self._camera))
            self._fruitless = 0 if any(one.evidence is not None for one in seen) else self._fruitless + 1
        return [self._found(track) for track in self._tracker.add(time_s, seen, speed_m_s)]

    def finish(self) -> list[FoundPlate]:
        """The plates that are in view at the end."""
        return [self._found(track) for track in self._tracker.finish()]

    def _is_due(self, speed_m_s: float | None) -> bool:
        self._waited += 1
        speed = speed_m_s if speed_m_s is not None else self._tracker.speed_m_s
        if speed is not None and speed < STANDING_M_S and self._tracker.expected:
            return self._waited >= STANDING_STEP
        return self._waited >= next((step for count, step in FRUITLESS if self._fruitless >= count), 1)

    def _has_candidates(self, half: Pixels) -> bool:
        planes = planes_of(half)
        return any(self._fits_the_road(quad) for quad in _candidates(planes))

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
        alone = tuple(seen.frame for seen in track.seen if seen.reading.code is not None)
        speed = track.speed_m_s()
        best = max((seen.reading for seen in track.seen), key=lambda r: (r.code is not None, r.confidence))
        evidence = track.evidence
        if len(track.seen) == 1 or not evidence:
            return FoundPlate(best, tuple(track.seen), alone, speed)
        joint = read_accumulated(evidence, self._codebook, self._camera)
        shown = {seen.reading.code.digits for seen in track.seen if seen.reading.code is not None}
        if len(shown | ({joint.code.digits} if joint.code else set())) > 1:
            reason = "frames of the plate show different codes"
            refused = [replace(seen, reading=_refused(seen.reading, reason)) for seen in track.seen]
            return FoundPlate(_refused(joint, reason), tuple(refused), (), speed, tuple(sorted(shown)))
        if joint.code is None:
            if all(seen.reading.code is None or self._stands_alone(seen.reading) for seen in track.seen):
                return FoundPlate(best if best.code is not None else joint, tuple(track.seen), alone, speed)
            # a stain that hides in small units shows in large ones
            reason = joint.reason or "the frames together do not show the digits of one of them"
            kept = [
                seen if self._stands_alone(seen.reading) else replace(seen, reading=_refused(seen.reading, reason))
                for seen in track.seen
            ]
            alone = tuple(seen.frame for seen in kept if seen.reading.code is not None)
            best = max((seen.reading for seen in kept), key=lambda r: (r.code is not None, r.confidence))
            taken_back = tuple(sorted(shown)) if len(alone) == 0 else ()
            return FoundPlate(best if best.code is not None else joint, tuple(kept), alone, speed, taken_back)
        frames = tuple(seen.frame for seen in track.seen if seen.evidence is not None)
        joint = replace(joint, frames=frames, grade=best.grade)
        return FoundPlate(joint, tuple(_with_code(seen, joint) for seen in track.seen), alone, speed)

    def _stands_alone(self, reading: PlateReading) -> bool:
        """Whether the code of one frame needs no other frame: a check or the registry confirms it."""
        code = reading.code
        return code is not None and (code.scheme is PlateScheme.ID or code.digits in self._known)


def _candidates(planes: Planes) -> Iterator[MarkerQuad]:
    for signal_of in (difference_signal, ratio_signal, coarse_ratio_signal):
        yield from detect_marker_quads(signal_of(planes))[:MAX_FITS]


def _with_code(seen: SeenPlate, joint: PlateReading) -> SeenPlate:
    """A sighting with the joint code, if its own units agree with it about everywhere."""
    if seen.reading.code is not None or joint.code is None or not _shows(seen.evidence, joint.code):
        return seen
    reading = replace(
        seen.reading, outcome=PlateOutcome.READ, code=joint.code, confidence=joint.confidence,
        cell_confidence=joint.cell_confidence, corrected_cells=joint.corrected_cells,
        from_codebook=joint.from_codebook, pose=seen.pose, reason="", frames=joint.frames,
    )  # fmt: skip
    return replace(seen, reading=reading)


def _shows(evidence: PlateEvidence | None, code: PlateCode) -> bool:
    if evidence is None or evidence.geometry.n != code.n or evidence.missing is not None:
        return False
    dark = code.units.reshape(-1)[unit_index(code.n).reshape(-1)] > 0
    odd = float((dark != evidence.units.dark).mean())
    return evidence.explained >= MIN_EXPLAINED_ALONE and odd <= MAX_ODD_UNITS


def _refused(reading: PlateReading, reason: str) -> PlateReading:
    return replace(reading, outcome=PlateOutcome.UNSURE, code=None, pose=None, grade=None, reason=reason)

"""Decoded paths against the true centre line."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from app.lanes.estimate import Lane
from app.sensors.pose_track import PoseTrack
from app.simulation.radio.lanes import TrueLane
from app.values import Floats

NEAR_M = 1.0  # [m] a true place is covered if the path is within this
MIN_CONFIDENCE = 0.5  # and if the path's confidence there is at least this
TOLERANCE_M = 0.25  # [m] source: the definition of confidence (docs/nomenclature.md)


@dataclass
class Tally:
    """Errors at true places every 0.25 m between the first and the last marker, over runs."""

    off_m: list[Floats] = field(default_factory=list)
    curvature_per_m: list[Floats] = field(default_factory=list)
    confidence: list[Floats] = field(default_factory=list)
    right: list[Floats] = field(default_factory=list)
    within_two_sigma: list[Floats] = field(default_factory=list)
    sigma_m: list[Floats] = field(default_factory=list)
    covered: int = 0
    places: int = 0
    runs: int = 0
    refused: int = 0

    def add(self, other: Tally) -> None:
        """Add the runs of another tally."""
        for name in ("off_m", "curvature_per_m", "confidence", "right", "within_two_sigma", "sigma_m"):
            getattr(self, name).extend(getattr(other, name))
        for name in ("covered", "places", "runs", "refused"):
            setattr(self, name, getattr(self, name) + getattr(other, name))

    @property
    def rms_m(self) -> float:
        """Of the distance from the true centre line to the path. [m]"""
        return _rms(self.off_m)

    @property
    def bound_m(self) -> float:
        """Standard deviation that the markers and the smoothness of roads leave at best, RMS. [m]

        It is the Cramér-Rao bound with the fitted smoothness as a prior: the inverse of the information.
        """
        return _rms(self.sigma_m)

    @property
    def worst_m(self) -> float:
        """[m]"""
        return max((float(o.max()) for o in self.off_m if len(o)), default=float("nan"))

    @property
    def curvature_rms_per_m(self) -> float:
        """[1/m]"""
        return _rms(self.curvature_per_m)

    @property
    def coverage(self) -> float:
        """Share of true places that a path covers."""
        return self.covered / max(self.places, 1)

    @property
    def confidence_and_share_right(self) -> tuple[float, float]:
        """Mean confidence of paths, and the share of places that were within 0.25 m of the centre."""
        parts = [np.concatenate(p) if p else np.full(1, np.nan) for p in (self.confidence, self.right)]
        return float(parts[0].mean()), float(parts[1].mean())

    @property
    def share_within_two_sigma(self) -> float:
        """Share of places whose error is within two of the path's standard deviations: 0.954 if those are right."""
        return float(np.concatenate(self.within_two_sigma).mean()) if self.within_two_sigma else float("nan")


class PlaceErrors(NamedTuple):
    """A path at true places every 0.25 m that are beside it."""

    # `off_m`, `confidence`, `sigma_m`, `curvature_off_per_m`: shape (N,): distance of the true centre line from the
    # path, what the path reports there, and the error of its curvature
    off_m: Floats
    confidence: Floats
    sigma_m: Floats
    curvature_off_per_m: Floats
    coverage: float  # share of all true places that a path covers

    @property
    def rms_m(self) -> float:
        """[m]"""
        return float(np.sqrt(np.mean(self.off_m**2))) if len(self.off_m) else float("nan")

    @property
    def worst_m(self) -> float:
        """[m]"""
        return float(self.off_m.max(initial=0.0))


def place_errors(lane: TrueLane, path: Lane, first_m: float, last_m: float) -> PlaceErrors | None:
    """Errors of a path at true places between two chainages; None where there is no path.

    Notes
    -----
    At each true place the error is the distance to the path; places beyond the path's ends have none, but count as not
    covered. A method without confidence counts as certain.
    """
    if path.refusal is not None or len(path.lon_deg) < 2:
        return None
    inside = (lane.chainage_m >= first_m) & (lane.chainage_m <= last_m)
    points = lane.enu_from_wgs84(path.lon_deg, path.lat_deg)
    off, at, beside = _distances_from_line(lane.centre_m[inside], points)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    confidence, sigma = np.interp(at, along, path.confidence), np.interp(at, along, path.sigma_m)
    covered = (off <= NEAR_M) & (~np.isfinite(confidence) | (confidence >= MIN_CONFIDENCE))
    bend = np.interp(at, along, path.curvature_per_m) - lane.curvature_per_m[inside]
    share = float(covered.sum()) / max(int(inside.sum()), 1)
    return PlaceErrors(off[beside], confidence[beside], sigma[beside], bend[beside], share)


def path_errors(lane: TrueLane, path: Lane, first_m: float, last_m: float) -> Tally:
    """Errors of a path, to add to those of other paths.

    Parameters
    ----------
    lane : TrueLane
    path : Lane
    first_m, last_m : float
        Chainages of the first and the last marker received. [m]
    """
    places = int(((lane.chainage_m >= first_m) & (lane.chainage_m <= last_m)).sum())
    tally, found = Tally(places=places, runs=1), place_errors(lane, path, first_m, last_m)
    if found is None:
        tally.refused = 1
        return tally
    reported = np.isfinite(found.confidence)
    tally.covered = round(found.coverage * places)
    tally.off_m.append(found.off_m)
    tally.curvature_per_m.append(found.curvature_off_per_m)
    tally.confidence.append(found.confidence[reported])
    tally.right.append((found.off_m[reported] <= TOLERANCE_M).astype(float))
    tally.sigma_m.append(found.sigma_m[reported])
    tally.within_two_sigma.append((found.off_m <= 2 * found.sigma_m)[reported].astype(float))
    return tally


def track_errors(lane: TrueLane, track: PoseTrack, first_m: float, last_m: float) -> Tally:
    """Errors of the vehicle's own positions, taken as the path."""
    inside = (lane.chainage_m >= first_m) & (lane.chainage_m <= last_m)
    points = lane.enu_from_wgs84(track.lon_deg, track.lat_deg)
    off, _at, beside = _distances_from_line(lane.centre_m[inside], points)
    return Tally([off[beside]], covered=int((off <= NEAR_M).sum()), places=int(inside.sum()), runs=1)


def _distances_from_line(places_m: Floats, line_m: Floats) -> tuple[Floats, Floats, npt.NDArray[np.bool_]]:
    """Distance of places from a line, where along it, and whether they are beside it rather than beyond an end.

    The nearest place of the line is on one of the two pieces at the nearest of its points, which are close together.
    """
    line = line_m[np.concatenate([[True], np.linalg.norm(np.diff(line_m, axis=0), axis=1) > 1e-9])]
    pieces = np.diff(line, axis=0)
    lengths = np.linalg.norm(pieces, axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    nearest = cKDTree(line).query(places_m)[1]
    off, at = np.full(len(places_m), np.inf), np.zeros(len(places_m))
    for piece in (np.maximum(nearest - 1, 0), np.minimum(nearest, len(pieces) - 1)):
        beside = places_m - line[piece]
        share = np.clip(np.einsum("ij,ij->i", beside, pieces[piece]) / lengths[piece] ** 2, 0.0, 1.0)
        away = np.linalg.norm(beside - share[:, None] * pieces[piece], axis=1)
        closer = away < off
        off, at = np.where(closer, away, off), np.where(closer, along[piece] + share * lengths[piece], at)
    return off, at, (at > 1e-6) & (at < along[-1] - 1e-6)


def _rms(parts: list[Floats]) -> float:
    together = np.concatenate(parts) if parts else np.zeros(0)
    return float(np.sqrt(np.mean(together**2))) if len(together) else float("nan")

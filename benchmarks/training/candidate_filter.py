"""``python -m benchmarks.training.candidate_filter [--seed N] [--frames N]``: coefficients of the candidates' filter.

Candidates of simulated frames with plates, of simulated frames without any, and of road photos as they are; a candidate
is true where its fit finds the plate's corners. A logistic regression learns from some seeds, and its ROC is printed on
others. Candidates on a plate that do not lead to a fit count neither way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate.detect_blobs import half_planes
from app.decoders.plate.detect_quads import MarkerQuad, detect_marker_quads
from app.decoders.plate.find_candidates import FEATURES, SIGNALS, candidate_features, possible_geometries
from app.decoders.plate.fit import fit_plate
from app.decoders.plate.reader import DEFAULT_GEOMETRIES
from app.errors import InvalidParameter
from app.markers.plate import PlateCode, PlateGeometry
from app.sensors.camera import Camera
from app.simulation.backgrounds import road_background
from app.simulation.camera import render_plate_scene
from app.simulation.conditions import Conditions, draw_daylight, draw_shadow, draw_stress
from app.simulation.plate_face import plate_face
from app.simulation.plate_scene import FaceTruth
from app.values import Floats
from benchmarks.plates.sets import Job, Shot, shoot
from benchmarks.plates.tables import table
from benchmarks.plates.views import read_photos
from benchmarks.scenes.places import draw_place, scene_under
from benchmarks.training import read_arguments

Image = npt.NDArray[np.uint8]

SHARES = (0.6, 0.2, 0.2)
"""[1] frames with plates of 8 x 8, 10 x 10 and 12 x 12 units."""
ROWS = (12.0, 120.0)
"""[px] heights of the plates' images."""
SAME_PLACE, SAME_CORNERS, SAME_CORNERS_PX = 0.25, 0.06, 1.5
"""[extent, extent, px] a candidate is on the plate when its centre is that near to the plate's, and its fit finds the
plate when no corner errs by more than the sum of the other two."""
RIDGE = 1.0
"""[1] penalty on the squares of the standardised coefficients."""


@dataclass(frozen=True, slots=True)
class Sample:
    """Features of a candidate under a geometry, and whether it is a plate."""

    features: Floats
    is_plate: bool


def draw_frames(seed: int, frames: int) -> Iterator[tuple[Image, PlateGeometry | None, FaceTruth | None]]:
    """Frames with plates, as many without, and the road photos."""
    rng = np.random.default_rng([seed, 16])
    for _ in range(frames):
        yield _draw_plate(rng)
    for shot in shoot(Job("free", 0, seed, frames)):
        if isinstance(shot, Shot):
            yield shot.frame.image, None, None
    for photo in read_photos():
        yield photo, None, None


def _draw_plate(rng: np.random.Generator) -> tuple[Image, PlateGeometry, FaceTruth]:
    geometry = DEFAULT_GEOMETRIES[int(rng.choice(3, p=SHARES))]
    code = PlateCode.from_position(float(rng.uniform(-180, 180)), float(rng.uniform(-80, 80)), n=geometry.n)
    conditions = _draw_conditions(rng)
    while True:
        camera = Camera.from_field_of_view(
            1920, 1080, float(rng.uniform(60, 90)), height_m=float(rng.uniform(1.2, 2.0)),
            depression_deg=float(rng.uniform(12, 45)), azimuth_deg=float(rng.normal(0, 8)),
        )  # fmt: skip
        try:
            face = plate_face(code, geometry, conditions.look, conditions.wear, rng)
            placed = draw_place(camera, face, rng, ROWS)
        except InvalidParameter:
            continue
        photos = read_photos()
        background = road_background(
            photos[int(rng.integers(len(photos)))], camera, rng, grain=float(rng.uniform(0.01, 0.05))
        )
        scene = scene_under(conditions, camera, (placed,), float(rng.uniform(0, 80)) / 3.6, rng)
        frame = render_plate_scene(scene, background, rng)
        return frame.image, geometry, frame.truths[0]


def _draw_conditions(rng: np.random.Generator) -> Conditions:
    """A third each: every degradation together, a fair day, one with shade and spots of paint."""
    kind = int(rng.integers(3))
    if kind == 0:
        return draw_stress(rng)
    conditions = draw_daylight(rng)
    if kind == 2:
        wear = replace(conditions.wear, paint_spots=int(rng.integers(0, 4)))
        conditions = replace(conditions, shadow=draw_shadow(rng), wear=wear)
    return conditions


def list_samples(image: Image, geometry: PlateGeometry | None, truth: FaceTruth | None) -> Iterator[Sample]:
    """The candidates of a frame, under every geometry that the reader would try."""
    planes = half_planes(image)
    for signal_of in SIGNALS:
        signal = signal_of(planes)
        for quad in detect_marker_quads(signal):
            for tried in possible_geometries(quad, DEFAULT_GEOMETRIES):
                features = candidate_features(signal, [quad], tried)[0]
                if truth is None or not _is_near(quad, truth):
                    yield Sample(features, False)
                elif tried == geometry and _finds(image, quad, tried, truth):
                    yield Sample(features, True)


def _is_near(quad: MarkerQuad, truth: FaceTruth) -> bool:
    apart = np.linalg.norm(quad.centroids_px.mean(axis=0) - truth.corners_px.mean(axis=0))
    return bool(apart < SAME_PLACE * np.ptp(truth.corners_px, axis=0).max())


def _finds(image: Image, quad: MarkerQuad, geometry: PlateGeometry, truth: FaceTruth) -> bool:
    fit = fit_plate(image, quad.centroids_px, geometry)
    limit_px = SAME_CORNERS * np.ptp(truth.corners_px, axis=0).max() + SAME_CORNERS_PX
    return fit is not None and bool(np.abs(fit.corners_px - truth.corners_px).max() < limit_px)


def collect(seed: int, frames: int) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Features, shape (S, features), and whether each is a plate, shape (S,), of all frames of a seed."""
    samples = [sample for frame in draw_frames(seed, frames) for sample in list_samples(*frame)]
    finite = [sample for sample in samples if np.isfinite(sample.features).all()]
    return np.array([s.features for s in finite]), np.array([s.is_plate for s in finite])


def regress(features: Floats, is_plate: npt.NDArray[np.bool_]) -> Floats:
    """Coefficients of the features and the constant: Newton's method on the penalised log likelihood."""
    mean, spread = features.mean(axis=0), features.std(axis=0) + 1e-9
    design = np.column_stack([(features - mean) / spread, np.ones(len(features))])
    ridge = np.diag([RIDGE] * features.shape[1] + [0.0])
    weights = np.zeros(design.shape[1])
    for _ in range(50):
        probability = 1 / (1 + np.exp(-design @ weights))
        slope = design.T @ (probability - is_plate) + ridge @ weights
        curvature = (design * (probability * (1 - probability))[:, None]).T @ design + ridge
        weights -= np.linalg.solve(curvature, slope)
    coefficients = weights[:-1] / spread
    return np.append(coefficients, weights[-1] - coefficients @ mean)


def roc_rows(log_odds: Floats, is_plate: npt.NDArray[np.bool_], limits: Sequence[float]) -> list[tuple[object, ...]]:
    """Plates lost and others kept by each limit."""
    rows: list[tuple[object, ...]] = []
    for limit in limits:
        lost = int((log_odds[is_plate] < limit).sum())
        kept = float((log_odds[~is_plate] >= limit).mean())
        rows.append(
            (f"{limit:g}", f"{lost} of {int(is_plate.sum())}", f"{100 * kept:.1f} % of {int((~is_plate).sum())}")
        )
    return rows


def main() -> None:
    """Learn, and print coefficients and ROC."""
    seed, frames = read_arguments("candidate_filter", __doc__, 1, "frames", 300)
    cv2.setNumThreads(1)
    weights = regress(*collect(seed, frames))
    features, is_plate = collect(seed + 1, frames)
    names = (*FEATURES, "constant")
    print("\n".join(f"    {weight:.3f},  # {name}" for name, weight in zip(names, weights, strict=True)))
    log_odds = features @ weights[:-1] + weights[-1]
    order = np.argsort(log_odds)
    ranks = np.empty(len(order))
    ranks[order] = np.arange(1, len(order) + 1)
    plates = int(is_plate.sum())
    area = (ranks[is_plate].sum() - plates * (plates + 1) / 2) / max(plates * (len(is_plate) - plates), 1)
    print(f"\nROC on seed {seed + 1}: area under the curve {area:.4f}\n")
    limits = [-math.inf, *range(-7, 3)]
    print(table(("log odds", "plates lost", "others kept"), roc_rows(log_odds, is_plate, limits)))


if __name__ == "__main__":
    main()

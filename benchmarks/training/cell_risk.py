"""``python -m benchmarks.training.cell_risk [--seed N] [--drives N]``: the risk that a cell hides what was built.

Plates of `id` and `position-robust` in weather, shade, glare, stains and wear, fitted where they are. A logistic
regression learns from the cells of one seed which of them show another symbol. On the next seed its predictions are
compared with what the cells show, beside those of the decoder.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate.detect_blobs import difference_signal, half_planes
from app.decoders.plate.fit import fit_plate, homography_from_points, project
from app.decoders.plate.marker_colours import measure_marker_colours
from app.decoders.plate.pose import marker_centroids
from app.decoders.plate.unit_likelihoods import (
    RISK_BESIDE_HIDDEN,
    RISK_CONSTANT,
    RISK_FLOOR,
    RISK_OF_LEVEL,
    RISK_OF_MISFIT,
    cell_misfits,
    hidden_beside,
    unit_log_likelihoods,
)
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.simulation.plate_scene import face_truth
from app.values import Floats
from benchmarks.plates.schemes import CANDIDATES, SCHEME_SETS, draw_drive, list_drives
from benchmarks.plates.tables import table
from benchmarks.training import read_arguments, reliability_rows
from benchmarks.training.candidate_filter import regress

FEATURES = ("level residual", "misfit", "beside a hidden marker")
DECODER = np.array([RISK_OF_LEVEL, RISK_OF_MISFIT, RISK_BESIDE_HIDDEN, RISK_CONSTANT])
EDGES = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)
_UNIT_SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


def list_cells(
    image: npt.NDArray[np.uint8], corners_px: Floats, geometry: PlateGeometry, code: PlateCode
) -> Iterator[tuple[Floats, bool]]:
    """Features of each cell of a plate, shape (3,), and whether it shows another symbol; none where no fit succeeds."""
    matrix = np.append(homography_from_points(_UNIT_SQUARE, corners_px), 1.0).reshape(3, 3)
    fit = fit_plate(image, project(matrix, marker_centroids(geometry)), geometry)
    units = None if fit is None else unit_log_likelihoods(fit)
    if fit is None or units is None:
        return
    colours = measure_marker_colours(difference_signal(half_planes(image)), fit.plate_from_image, geometry)
    features = np.stack([
        np.log(np.abs(units.level_residual) + RISK_FLOOR),
        np.log(np.maximum(cell_misfits(fit), 1.0)),
        hidden_beside(colours.tints, geometry.n),
    ], axis=1)  # fmt: skip
    yield from zip(features, (bool(wrong) for wrong in units.best != np.asarray(code.symbols)), strict=True)


def collect(seed: int, drives: int) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Features, shape (cells, 3), and whether each cell shows another symbol, shape (cells,), of a seed."""
    cells: list[tuple[Floats, bool]] = []
    for drive in list_drives([seed], drives, SCHEME_SETS):
        drawn = draw_drive(drive)
        for candidate in (one for one in CANDIDATES if one.scheme in (PlateScheme.ID, PlateScheme.POSITION_ROBUST)):
            face, codes = drawn.plate(candidate)
            for scene, image in drawn.frames(face):
                corners_px = face_truth(scene, scene.faces[0]).corners_px
                cells += list_cells(image, corners_px, candidate.geometry, codes[0])
    return np.array([features for features, _ in cells]), np.array([wrong for _, wrong in cells])


def risks(features: Floats, weights: Floats) -> Floats:
    """Probability that each cell shows another symbol, shape (cells,)."""
    return np.asarray(1 / (1 + np.exp(-features @ weights[:-1] - weights[-1])))


def main() -> None:
    """Learn, and print the coefficients and how reliable they are."""
    seed, drives = read_arguments("cell_risk", __doc__, 11, "drives", 3)
    cv2.setNumThreads(1)
    learnt = regress(*collect(seed, drives))
    features, wrong = collect(seed + 1, drives)
    names = (*FEATURES, "constant")
    rows = [(name, f"{new:.3f}", f"{old:.3f}") for name, new, old in zip(names, learnt, DECODER, strict=True)]
    print(table(("coefficient", "learnt", "of the decoder"), rows))
    for name, weights in (("learnt", learnt), ("of the decoder", DECODER)):
        risk = np.clip(risks(features, weights), 1e-9, 1 - 1e-9)
        loss = -np.where(wrong, np.log(risk), np.log(1 - risk)).mean()
        print(f"\n{name}: a loss of {loss:.3f} nats a cell on seed {seed + 1}\n")
        print(table(("risk", "cells", "mean risk", "wrong"), reliability_rows(risk, wrong, EDGES)))


if __name__ == "__main__":
    main()

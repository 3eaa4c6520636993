"""Which quadruples of markers become candidates, and which are refused before a fit."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from app.decoders.plate import reader
from app.decoders.plate.detect_blobs import (
    AREA,
    COLUMNS,
    PEAK,
    SIGN,
    WEIGHT,
    X0,
    X1,
    XX,
    Y0,
    Y1,
    YY,
    X,
    Y,
    difference_signal,
    half_planes,
)
from app.decoders.plate.detect_quads import (
    MARKER_RATIO,
    MAX_GREENS,
    MAX_QUADS,
    MAX_REDS,
    MarkerQuad,
    Nearest,
    Quads,
    join_green_triples,
    join_red_quads,
)
from app.decoders.plate.find_candidates import (
    FEATURES,
    MIN_LOG_ODDS,
    Candidate,
    candidate_features,
    candidate_log_odds,
    find_candidates,
    possible_geometries,
)
from app.decoders.plate.fit import homography_from_points, project
from app.decoders.plate.pose import marker_centroids
from app.decoders.plate.reader import DEFAULT_GEOMETRIES, LIMITS, decode_plates
from app.markers.plate import PlateCode, PlateGeometry
from app.simulation.plate_scene import PlacedFace
from app.values import Floats
from tests.decoders.plate.scenes import AHEAD_M, face_of, road, shoot, shoot_plate

Image = npt.NDArray[np.uint8]
GEOMETRY = PlateGeometry()
SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


def true_quad(corners_px: Floats, geometry: PlateGeometry = GEOMETRY, rank: float = 3.0) -> MarkerQuad:
    """The quadruple that perfect blobs would give."""
    image_from_plate = np.append(homography_from_points(SQUARE, corners_px), 1.0).reshape(3, 3)
    return MarkerQuad(project(image_from_plate, marker_centroids(geometry)), 7, rank, MARKER_RATIO[geometry.n])


def odds_of(image: Image, quad: MarkerQuad, geometry: PlateGeometry = GEOMETRY) -> float:
    return float(candidate_log_odds(difference_signal(half_planes(image)), [quad], geometry)[0])


@pytest.mark.parametrize("n", [8, 10, 12])
@pytest.mark.parametrize("turn_deg", [0.0, 75.0, 200.0])
def test_a_plate_is_worth_a_fit_and_the_road_beside_it_is_not(n: int, turn_deg: float) -> None:
    code = PlateCode.from_position(8.4, 49.0, n=n)
    frame = shoot(PlacedFace(face_of(code), AHEAD_M, 0.0, turn_deg))
    corners = frame.truths[0].corners_px
    geometry = PlateGeometry(n)
    assert odds_of(frame.image, true_quad(corners, geometry), geometry) > 0
    beside = corners + np.array([1.6 * np.ptp(corners[:, 0]), 0.0])
    assert odds_of(frame.image, true_quad(beside, geometry), geometry) < MIN_LOG_ODDS


def test_markers_of_another_plate_do_not_make_a_candidate() -> None:
    """Between the markers of two plates there is road, not a grid."""
    faces = [PlacedFace(face_of(), AHEAD_M, left_m, 0.0) for left_m in (-0.5, 0.5)]
    frame = shoot(*faces)
    right, left = sorted((truth.corners_px for truth in frame.truths), key=lambda c: -c[:, 0].mean())
    across = np.array([left[1], right[0], right[3], left[2]])
    assert odds_of(frame.image, true_quad(across)) < MIN_LOG_ODDS


def test_a_quadruple_without_an_inverse_is_refused() -> None:
    centroids = np.array([(10.0, 10.0), (20.0, 10.0), (30.0, 10.0), (40.0, 10.0)])
    quad = MarkerQuad(centroids, 7, 5.0, MARKER_RATIO[8])
    image = road()
    assert np.isnan(candidate_features(difference_signal(half_planes(image)), [quad], GEOMETRY)).all()
    assert odds_of(image, quad) == -np.inf


def test_features_do_not_depend_on_the_order_of_candidates() -> None:
    frame = shoot_plate()
    signal = difference_signal(half_planes(frame.image))
    quads = [true_quad(frame.truths[0].corners_px), true_quad(frame.truths[0].corners_px + 40)]
    features = candidate_features(signal, quads, GEOMETRY)
    assert features.shape == (2, len(FEATURES))
    np.testing.assert_array_equal(features, candidate_features(signal, quads[::-1], GEOMETRY)[::-1])


def test_eight_by_eight_is_always_tried() -> None:
    """Stained squares look small: their distance over their side is that of 12 x 12."""
    quad = MarkerQuad(np.zeros((4, 2)), 7, 1.0, 1.2 * MARKER_RATIO[12])
    assert GEOMETRY in possible_geometries(quad, DEFAULT_GEOMETRIES)


@pytest.mark.parametrize("n", [8, 10, 12])
def test_the_likeliest_geometry_is_tried_first(n: int) -> None:
    frame = shoot(PlacedFace(face_of(PlateCode.from_position(8.4, 49.0, n=n)), AHEAD_M, 0.0, 0.0))
    _signal, candidates = next(find_candidates(half_planes(frame.image), DEFAULT_GEOMETRIES))
    assert candidates[0].geometries[0].n == n
    assert candidates[0].log_odds == max(candidate.log_odds for candidate in candidates)


@pytest.mark.parametrize(
    ("log_odds", "found"), [(LIMITS.min_second_log_odds, [10]), (LIMITS.min_second_log_odds - 0.1, [])]
)
def test_a_poor_fit_of_one_geometry_gives_up_an_unlikely_candidate_only(
    monkeypatch: pytest.MonkeyPatch, log_odds: float, found: list[int]
) -> None:
    frame = shoot(PlacedFace(face_of(PlateCode.from_position(8.4, 49.0, n=10)), AHEAD_M, 0.0, 0.0))
    quad = true_quad(frame.truths[0].corners_px, PlateGeometry(10))
    candidate = Candidate(quad, (PlateGeometry(12), PlateGeometry(10)), log_odds)
    signal = difference_signal(half_planes(frame.image))
    monkeypatch.setattr(reader, "find_candidates", lambda planes, geometries: [(signal, [candidate])])
    assert [reading.code.n for reading in decode_plates(frame.image) if reading.code] == found


def test_the_grid_between_the_markers_counts() -> None:
    """A rank far below even odds is worth a fit on a plate; the same markers around a grey field are worth less."""
    frame = shoot_plate()
    corners = frame.truths[0].corners_px
    weak = true_quad(corners, rank=-1.5)
    assert odds_of(frame.image, weak) > MIN_LOG_ODDS
    image = frame.image.copy()
    inner = np.array([(0.02, 0.28), (0.28, 0.28), (0.28, 0.02), (0.72, 0.02), (0.72, 0.28), (0.98, 0.28), (0.98, 0.72),
                      (0.72, 0.72), (0.72, 0.98), (0.28, 0.98), (0.28, 0.72), (0.02, 0.72)])  # fmt: skip
    image_from_plate = np.append(homography_from_points(SQUARE, corners), 1.0).reshape(3, 3)
    cv2.fillPoly(image, [np.rint(project(image_from_plate, inner)).astype(np.int32)], (110, 112, 115))
    assert odds_of(image, weak) < odds_of(frame.image, weak) - 2


def square_blob(sign: float, x: float, y: float, side: float, peak: float) -> Floats:
    """A blob as `find_blobs` describes one."""
    blob = np.zeros(COLUMNS)
    blob[[SIGN, WEIGHT, X, Y]] = sign, peak * side * side, x, y
    blob[[XX, YY]] = side * side / 12
    blob[[AREA, PEAK]] = side * side, peak
    blob[[X0, X1, Y0, Y1]] = x - side / 2, x + side / 2, y - side / 2, y + side / 2
    return blob


def test_no_quadruple_is_dropped_for_its_place_in_the_list() -> None:
    """A pattern of strong red and green spots makes more quadruples than a thousand; the weak plate's comes last."""
    rng = np.random.default_rng(2)
    spots = [
        square_blob(1.0 if rng.random() < 0.5 else -1.0, 10 + 20 * column, 10 + 20 * row, 6.0, 90.0)
        for row in range(15) for column in range(16)
    ]  # fmt: skip
    plate = [
        square_blob(sign, x, y, 6.0, 30.0)
        for sign, x, y in ((1.0, 500.0, 300.0), (-1.0, 520.0, 300.0), (-1.0, 520.0, 320.0), (-1.0, 500.0, 320.0))
    ]
    blobs = np.array(spots + plate)
    reds, greens = (np.flatnonzero(blobs[:, SIGN] == sign) for sign in (1.0, -1.0))
    assert len(reds) <= MAX_REDS
    assert len(greens) <= MAX_GREENS
    quads = Quads.empty(MAX_QUADS)
    found = join_green_triples(blobs, greens, np.zeros((400, 600), np.int16), Nearest.empty(), quads)
    found = join_red_quads(blobs, reds, greens, Nearest.empty(), quads, found)
    assert found > 1000
    centroids = np.array([blob[[X, Y]] for blob in plate])
    assert any((np.abs(found_px - centroids) < 1e-9).all() for found_px in quads.centroids[:found])

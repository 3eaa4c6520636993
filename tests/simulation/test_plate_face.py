"""The simulated plate's face against the code's layout in millimetres."""

from __future__ import annotations

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.markers.plate import PlateCode, PlateGeometry
from app.simulation.plate_face import PlateLook, PlateWear, draw_look, grid_face, plate_face
from benchmarks.scenes.thermal import PlateWarmth, warm_face

LOOK = PlateLook()


def face_of(digits: str, **kwargs) -> np.ndarray:
    code = PlateCode(digits, n=kwargs.pop("n", 8))
    geometry = PlateGeometry(code.n, **kwargs)
    return plate_face(code, geometry, LOOK, PlateWear(), np.random.default_rng(0)).reflectance


def at(face: np.ndarray, x_mm: float, y_mm: float, side_mm: float = 325.0) -> tuple[float, ...]:
    scale = face.shape[0] / side_mm
    return tuple(round(float(v), 3) for v in face[int(y_mm * scale), int(x_mm * scale)])


def test_markers_stand_where_the_paper_puts_them():
    face = face_of("023792168411")
    assert at(face, 20, 20) == LOOK.red  # inside the triangle, by the plate's corner
    assert at(face, 70, 70) == LOOK.triangle_rest  # the half that it leaves free
    assert at(face, 325 - 40, 40) == at(face, 40, 325 - 40) == at(face, 325 - 40, 325 - 40) == LOOK.green
    assert at(face, 2, 160) == at(face, 160, 2) == at(face, 323, 160) == LOOK.gap  # the border


def test_units_follow_the_papers_example():
    face = face_of("023792168411")
    middles = 5 + 17.5 + 40 * np.arange(8)
    dark = np.array([[at(face, x, y) == LOOK.dark for x in middles] for y in middles])
    # the paper's matrix [999 0 2 999; 3 7 9 2; 1 6 8 4; 999 1 1 999], four units a cell, dark = 1
    expected = [
        "00 00 00 00",
        "00 00 10 00",
        "00 01 10 00",
        "11 11 01 10",
        "00 01 10 01",
        "01 10 00 00",
        "00 00 00 00",
        "00 01 01 00",
    ]
    want = np.array([[c == "1" for c in row.replace(" ", "")] for row in expected])
    np.testing.assert_array_equal(dark, want)


def test_areas_are_exact_where_edges_fall_between_texels():
    geometry = PlateGeometry(unit_mm=33.3, gap_mm=4.7)
    face = plate_face(PlateCode("0" * 12), geometry, LOOK, PlateWear(), np.random.default_rng(0)).reflectance
    green = 3 * (2 * 33.3 + 4.7) ** 2
    light = 48 * 33.3**2
    red = (2 * 33.3 + 4.7) ** 2 / 2
    gap = geometry.side_mm**2 - green - light - 2 * red
    expected = green * LOOK.green[1] + light * LOOK.light[1] + red * (LOOK.red[1] + LOOK.triangle_rest[1])
    assert face[..., 1].mean() * geometry.side_mm**2 == pytest.approx(expected + gap * LOOK.gap[1], rel=1e-3)


def test_code_of_another_size_is_refused():
    with pytest.raises(InvalidParameter, match="10 x 10"):
        plate_face(PlateCode("0" * 21, n=10), PlateGeometry(), LOOK, PlateWear(), np.random.default_rng(0))


def test_wear_takes_contrast_and_dirt_covers():
    code, geometry = PlateCode("023792168411"), PlateGeometry()
    new = plate_face(code, geometry, LOOK, PlateWear(), np.random.default_rng(0)).reflectance
    pale = plate_face(code, geometry, LOOK, PlateWear(contrast_loss=0.5), np.random.default_rng(0)).reflectance
    assert pale.std() == pytest.approx(new.std() / 2, rel=0.01)
    worn = plate_face(code, geometry, LOOK, PlateWear(patchy_loss=0.8), np.random.default_rng(0)).reflectance
    change = np.abs(worn - new).max(axis=2)
    assert 0.1 < (change > 0.05).mean() < 0.9  # patches, not everywhere
    dirty = plate_face(code, geometry, LOOK, PlateWear(dirt_blobs=3), np.random.default_rng(0)).reflectance
    assert 0.002 < (np.abs(dirty - new).max(axis=2) > 0.1).mean() < 0.2


def test_lit_units_shine_and_dark_ones_do_not():
    look = PlateLook(led=0.5)
    face = plate_face(PlateCode("023792168411"), PlateGeometry(), look, PlateWear(), np.random.default_rng(0))
    assert face.emission is not None
    middle = 5 + 17.5
    assert face.emission[int(middle), int(middle + 2 * 40)] == pytest.approx(0.5, abs=0.01)  # light unit
    assert face.emission[int(middle + 3 * 40), int(middle)] == pytest.approx(0, abs=0.01)  # dark unit
    green = face.emission[40, 285]
    assert green[1] == pytest.approx(0.5, abs=0.01)
    assert green[2] < 0.3


def test_dark_units_and_markers_are_warm():
    face = warm_face(PlateCode("023792168411"), PlateGeometry(), PlateWarmth(), np.random.default_rng(0))
    assert face.emission is not None
    kelvin = face.emission[..., 0]
    assert kelvin[285, 40] > 9
    assert kelvin[20, 20] > 9
    assert kelvin[int(22.5 + 3 * 40), 22] > 9
    assert kelvin[22, int(22.5 + 2 * 40)] < 4
    assert kelvin[65, 65] < 4


def test_grid_face_is_square_cells():
    cells = np.zeros((8, 8, 3))
    cells[2, 5] = 0.7
    face = grid_face(cells, 0.325, PlateWear(), np.random.default_rng(0)).reflectance
    share = face.shape[0] / 8
    lit = np.argwhere(face[..., 0] > 0.5)
    np.testing.assert_allclose(lit.min(axis=0), (2 * share, 5 * share))
    np.testing.assert_allclose(lit.max(axis=0), (3 * share - 1, 6 * share - 1))


def test_drawn_looks_vary_and_keep_their_colours():
    rng = np.random.default_rng(2)
    looks = [draw_look(rng) for _ in range(200)]
    assert all(look.light[1] > 4 * look.dark[1] for look in looks)
    assert all(look.red[2] > 2.5 * max(look.red[:2]) for look in looks)
    assert all(look.green[1] > 1.5 * max(look.green[0], look.green[2]) for look in looks)
    gaps = np.array([look.gap[1] / look.light[1] for look in looks])
    assert (gaps > 0.7).mean() > 0.15  # light base plates
    assert (gaps < 0.3).mean() > 0.15  # dark ones

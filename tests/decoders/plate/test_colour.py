"""What counts as red, green and grey under a colour cast."""

from __future__ import annotations

import numpy as np
import pytest

from app.decoders.plate.detect_blobs import difference_signal, half_planes
from app.decoders.plate.marker_colours import ALONE, MarkerColours, measure_marker_colours
from app.markers.plate import PlateGeometry

GEOMETRY = PlateGeometry()
SIDE_PX = 320
Colour = tuple[int, int, int]  # blue, green, red


def colours_of(triangle: Colour, squares: Colour, units: Colour) -> MarkerColours:
    """Colours of a plate that fills a picture."""
    image = np.full((SIDE_PX, SIDE_PX, 3), units, np.uint8)
    image[:80, :80] = triangle
    image[:80, -80:] = image[-80:, :80] = image[-80:, -80:] = squares
    plate_from_image = np.diag([1 / SIDE_PX, 1 / SIDE_PX, 1.0])
    signal = difference_signal(half_planes(image))
    return measure_marker_colours(signal, plate_from_image, GEOMETRY)


def test_a_black_triangle_with_a_purple_tint_is_not_red() -> None:
    """Lateral chromatic aberration tints what is black: much redder than green, but no redder than blue."""
    colours = colours_of((40, 30, 46), (49, 73, 49), (100, 106, 116))
    assert colours.tints[0] < ALONE.min_tint
    np.testing.assert_allclose(colours.tints[1:], 1.0)


@pytest.mark.parametrize("cast", [(1.0, 1.0, 1.0), (0.8, 1.0, 1.2), (1.2, 1.0, 0.8)])
def test_a_red_triangle_is_red_under_a_cast(cast: tuple[float, float, float]) -> None:
    triangle, squares, units = (
        tuple(int(v * c) for v, c in zip(colour, cast, strict=True))
        for colour in ((40, 45, 120), (70, 140, 60), (150, 150, 150))
    )
    colours = colours_of(triangle, squares, units)
    assert colours.tints.min() > ALONE.min_tint
    assert ALONE.cast[0] < colours.cast.min()
    assert colours.cast.max() < ALONE.cast[1]
    np.testing.assert_allclose(colours.cast, (cast[0], cast[2]), rtol=0.02)


def test_amber_is_no_grey() -> None:
    """A traffic light's disc between its red and its green once passed for a plate."""
    assert colours_of((11, 8, 90), (20, 60, 12), (40, 131, 183)).cast.min() < ALONE.cast[0]

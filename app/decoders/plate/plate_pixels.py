"""What the hypotheses about a plate's units are compared on: pixels, pattern, light and spots of paint."""

from __future__ import annotations

from typing import NamedTuple

from app.decoders.plate.profiles import Floats


class PlatePixels(NamedTuple):
    """The pixels on a plate.

    Attributes
    ----------
    light : ndarray, shape (P,)
        Without the haze. [linear, 1 = saturation]
    weight : ndarray, shape (P,)
        Of the squared error, 1 on average.
    units : ndarray, shape (P, units)
        Share of each unit in each pixel, in the order of the symbols' units.
    rest : ndarray, shape (P, 6)
        Shares of the gaps, the triangle, the other half of its cell and the three squares.
    places_mm : ndarray, shape (P, 2)
    level : float
        Light of the lightest units without the haze.
    blur_mm : float
        Standard deviation of the blur on the plate. [mm]
    """

    light: Floats
    weight: Floats
    units: Floats
    rest: Floats
    places_mm: Floats
    level: float
    blur_mm: float


class PlatePattern(NamedTuple):
    """The pattern that is verified, and its units.

    Attributes
    ----------
    dark : ndarray, shape (units,)
        1 for the dark units of the pattern, 0 for the light ones.
    seen : ndarray, shape (P,)
        Reflectance that each pixel sees of the pattern; white is 1.
    dark_albedo : float
        Reflectance of dark units.
    white_spread, dark_spread : float
        Standard deviations of the reflectances of light and of dark units, each unit's own. [white]
    centres_mm : ndarray, shape (units, 2)
    reach_mm, inner_mm : float
        Around a unit's centre, within which pixels are compared, and within which lies what pixels see of it.
    """

    dark: Floats
    seen: Floats
    dark_albedo: float
    white_spread: float
    dark_spread: float
    centres_mm: Floats
    reach_mm: float
    inner_mm: float


class LightPrior(NamedTuple):
    """Light on the plate before the pixels around a unit are compared.

    Attributes
    ----------
    field, noise : ndarray, shape (P,)
        Light on each pixel, and variance of its error.
    spread : float
        Standard deviation of the light, relative.
    length_mm, level_variance : float
        Distance over which the correlation of the light falls to 1/e, and the variance of its mean, relative.
    veil_variance, veil_length_mm : float
        Variance of the error of light that the plate does not send, and length over which that changes.
    """

    field: Floats
    noise: Floats
    spread: float
    length_mm: float
    level_variance: float
    veil_variance: float = 0.0
    veil_length_mm: float = 1.0


class Spots(NamedTuple):
    """Spots of paint that may hide a unit.

    Attributes
    ----------
    shapes : ndarray, shape (6, spots)
        Centre around the unit's, inverse shape xx, xy, yy, mean radius. [mm]
    paints, opacities : ndarray
        Reflectances [white] and shares of the light that the paint hides.
    """

    shapes: Floats
    paints: Floats
    opacities: Floats

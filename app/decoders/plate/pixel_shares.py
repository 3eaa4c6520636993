"""The shares that the shapes of a fitted plate have in each pixel around it."""

from __future__ import annotations

from app.compiled import kernel, loop
from app.decoders.plate.profiles import Floats, Ints
from app.decoders.plate.quadrature import Quadrature, blur_quadrature
from app.decoders.plate.synthesis import (
    FIRST_GAP,
    FIRST_ROAD,
    SINGLES,
    PlateModel,
    PlatePatch,
    Scratch,
    blur_on_plate,
    lens_blur,
    new_scratch,
    place_pixel,
    synthesize,
)


@kernel
def set_pixel_shares(patch: PlatePatch, model: PlateModel, max_nodes: int, shares: Floats, places: Floats) -> None:
    """Set the shares of all shapes and the place on the plate of every pixel of a patch.

    Parameters
    ----------
    patch : PlatePatch
    model : PlateModel
    max_nodes : int
        Quadrature nodes on each side of the middle at most.
    shares : ndarray, shape (h, w, shapes)
        Set to what each shape has in each pixel; 0 where the pixel is not in front of the camera.
    places : ndarray, shape (h, w, 2)
        Set to the pixel's place. [plate sides]
    """
    quadrature = blur_quadrature(model.pose, model.frame, patch.grid, max_nodes, False)
    scratch = new_scratch(model.values.shape[0], model.edges.shape[0])
    _set_all(patch, model, quadrature, scratch, shares, places)


@loop
def _set_all(
    patch: PlatePatch, model: PlateModel, quadrature: Quadrature, scratch: Scratch, shares: Floats, places: Floats
) -> None:
    """Set the shares and the places of all pixels."""
    row, along_u, along_v = scratch
    lens = lens_blur(model.pose, patch.grid)
    for y in range(patch.light.shape[0]):
        for x in range(patch.light.shape[1]):
            pixel = place_pixel(model.pose, model.frame, patch.grid, x, y)
            for k in range(shares.shape[2]):
                shares[y, x, k] = 0.0
            places[y, x, 0] = pixel.u
            places[y, x, 1] = pixel.v
            if pixel.inverse_depth <= 0.0 or not (-0.2 < pixel.u < 1.2 and -0.2 < pixel.v < 1.2):
                continue
            variance_u, variance_v = blur_on_plate(pixel, lens, quadrature)
            entries, _slopes = synthesize(
                pixel, variance_u, variance_v, model, quadrature, 0.0, 0.0, row, along_u, along_v
            )
            for e in range(entries):
                shares[y, x, row.shape[e]] = row.share[row.shape[e]]
                row.share[row.shape[e]] = 0.0


@kernel
def gather_shares(
    shares: Floats, order: Ints, min_share: float, max_road: float, used: Ints, units: Floats, rest: Floats
) -> int:
    """Gather the shares in the pixels on a plate; returns their number.

    Parameters
    ----------
    shares : ndarray, shape (pixels, shapes)
        Of `set_pixel_shares`.
    order : ndarray of int, shape (units,)
        Shapes of the units that are wanted.
    min_share, max_road : float
        Share of all shapes in a pixel from which on, and of the road up to which it is on the plate.
    used : ndarray of int, shape (pixels,)
        Set to the numbers of these pixels.
    units : ndarray, shape (pixels, units)
        Set to the shares of the units in them.
    rest : ndarray, shape (pixels, 1 + FIRST_GAP)
        Set to those of the gaps with what the pixel has of the road, and of the markers' parts.
    """
    shapes = shares.shape[1]
    base = shapes - SINGLES
    count = 0
    for p in range(shares.shape[0]):
        total = 0.0
        for k in range(shapes):
            total += shares[p, k]
        road = 0.0
        for k in range(base + FIRST_ROAD, shapes):
            road += shares[p, k]
        if total <= min_share or road >= max_road:
            continue
        used[count] = p
        rest[count, 0] = road
        for k in range(FIRST_GAP, FIRST_ROAD):
            rest[count, 0] += shares[p, base + k]
        for k in range(FIRST_GAP):
            rest[count, 1 + k] = shares[p, base + k]
        for k in range(order.size):
            units[count, k] = shares[p, order[k]]
        count += 1
    return count

"""The shares that the shapes of a fitted plate have in each pixel around it."""

from __future__ import annotations

import numpy as np

from app.decoders.compiled import kernel
from app.decoders.plate.profiles import AxisProfiles, Floats
from app.decoders.plate.quadrature import blur_quadrature
from app.decoders.plate.synthesis import (
    PlateModel,
    PlatePatch,
    blur_on_plate,
    lens_blur,
    new_row,
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
    n = model.edges.shape[0]
    shapes = model.values.shape[0]
    along_u = AxisProfiles(np.zeros((n + 3, 4)), np.zeros(2, np.int64))
    along_v = AxisProfiles(np.zeros((n + 3, 4)), np.zeros(2, np.int64))
    row = new_row(shapes)
    lens = lens_blur(model.pose, patch.grid)
    quadrature = blur_quadrature(model.pose, model.frame, patch.grid, max_nodes, False)
    for y in range(patch.light.shape[0]):
        for x in range(patch.light.shape[1]):
            pixel = place_pixel(model.pose, model.frame, patch.grid, x, y)
            shares[y, x] = 0.0
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

"""Blobs of a signal against those of scipy's labels, and their moments against numpy's."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage

from app.decoders.plate.detect_blobs import (
    AREA,
    MIN_AREA,
    PEAK,
    PIXEL_VARIANCE,
    SIGN,
    WEIGHT,
    X0,
    X1,
    XX,
    XY,
    Y0,
    Y1,
    YY,
    X,
    Y,
    difference_signal,
    find_blobs,
    half_planes,
    ratio_signal,
)


def sorted_blobs(blobs: np.ndarray) -> np.ndarray:
    return blobs[np.lexsort(np.round(blobs[:, [WEIGHT, Y0, X0, SIGN]], 6).T)]


def spotted(height: int, width: int) -> np.ndarray:
    """A grey frame with noise and coloured discs, some of which touch, some at the edges."""
    rng = np.random.default_rng(3)
    frame = rng.normal(110, 3, (height, width, 3))
    rows, columns = np.mgrid[:height, :width]
    for _ in range(150):
        x, y, radius = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(1, 30)
        colour = (40, 60, 190) if rng.random() < 0.5 else (50, 160, 40)
        frame[(columns - x) ** 2 + (rows - y) ** 2 < radius**2] = colour
    return frame.clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("signal_of", [difference_signal, ratio_signal])
@pytest.mark.parametrize("size", [(360, 640), (333, 517)])
def test_blobs_are_those_of_scipy(signal_of, size: tuple[int, int]) -> None:
    signal = signal_of(half_planes(spotted(*size)))
    expected = []
    block = 16
    threshold = np.kron(signal.threshold, np.ones((block, block), int))[: signal.opponent.shape[0]]
    strength = np.abs(signal.opponent.astype(int))
    for floor, slack in signal.levels:
        exceeds = strength > np.maximum(threshold[:, : strength.shape[1]], floor)
        exceeds &= 32 * strength > slack * signal.planes.luma.astype(int)
        for sign in (1, -1):
            labels, count = scipy.ndimage.label(exceeds & (np.sign(signal.opponent) == sign), np.ones((3, 3)))
            for label in range(1, count + 1):
                y, x = np.nonzero(labels == label)
                if len(x) < MIN_AREA:
                    continue
                w = strength[y, x]
                mean_x, mean_y = np.average(x, weights=w), np.average(y, weights=w)
                row = np.zeros(13)
                row[SIGN], row[WEIGHT], row[AREA], row[PEAK] = sign, w.sum(), len(x), w.max()
                row[X], row[Y] = mean_x, mean_y
                row[X0], row[X1], row[Y0], row[Y1] = x.min(), x.max(), y.min(), y.max()
                row[XX] = np.average((x - mean_x) ** 2, weights=w) + PIXEL_VARIANCE
                row[YY] = np.average((y - mean_y) ** 2, weights=w) + PIXEL_VARIANCE
                row[XY] = np.average((x - mean_x) * (y - mean_y), weights=w)
                expected.append(row)
    found = find_blobs(signal)
    assert len(found) == len(expected) > 50
    np.testing.assert_allclose(sorted_blobs(found), sorted_blobs(np.array(expected)), atol=1e-6)

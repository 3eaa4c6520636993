"""Likelihood ratios of the tests, for many markers at once."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

DISPLACEMENT_M, DISPLACEMENT_SHARE = (1.5, 15.0), (0.9, 0.1)
"""Standard deviations of a moved marker's displacement before it is seen, each axis [m], and how common they are:
pushed aside, or installed or programmed at another place. Source: by hand."""
WIDE_SHARE, WIDE_SIGMAS = 0.05, 3.0
"""Share of offsets with so many times the stated error. Source: by hand; position errors have heavy tails."""
OUTLIER_SHARE, OUTLIER_M = 0.02, 10.0
"""Share of offsets that are wrong altogether, evenly within this distance [m]. Source: by hand."""
DISC_POINTS = 8
"""Points on the edge of the disc in which a marker counts as not moved. Source: by hand."""
_OUTLIER_DENSITY = OUTLIER_SHARE / (np.pi * OUTLIER_M**2)


def _normal(square: Floats, variance: Floats) -> Floats:
    """Density of a normal distribution on the plane, by the squared distance. [1/m2]"""
    return np.asarray(np.exp(-0.5 * square / variance) / (2.0 * np.pi * variance))


def _offset_density(square: Floats, variance: Floats, spread: Floats | float) -> Floats:
    """Density of an offset by its squared distance from where it is expected, with what that is uncertain by [m2]."""
    near = _normal(square, variance + spread)
    wide = _normal(square, WIDE_SIGMAS**2 * variance + spread)
    return (1.0 - WIDE_SHARE - OUTLIER_SHARE) * near + WIDE_SHARE * wide + _OUTLIER_DENSITY


def moved_ratios(
    offset_m: Floats, sigma_m: Floats, used: npt.NDArray[np.bool_], disc_m: Floats, bound: float
) -> tuple[Floats, Floats]:
    """Log-likelihood ratio of a marker that has moved against one that has not, and where it is.

    Parameters
    ----------
    offset_m : ndarray, shape (M, K, 2)
        Of M markers as K vehicles saw them, in the order of their passes. [m]
    sigma_m : ndarray, shape (M, K)
        Standard deviation on each axis. [m]
    used : ndarray of bool, shape (M, K)
    disc_m : ndarray, shape (M,)
        A marker within it has not moved. [m]
    bound : float
        What one vehicle adds at most. [nat]

    Returns
    -------
    ratio : ndarray, shape (M,)
        [nat]
    displacement_m : ndarray, shape (M, 2)
        Estimated. [m]

    Notes
    -----
    The displacement is not known, so each pass is predicted from the passes before it: the product of such predictions
    is a likelihood, and the bound of Wald's test holds for it (Robbins and Siegmund, Annals of Statistics 2, 1974). The
    marker that has not moved is taken where it fits the passes best within the disc.
    """
    angle = 2.0 * np.pi * np.arange(DISC_POINTS) / DISC_POINTS
    ring = np.vstack([np.zeros((1, 2)), np.column_stack([np.cos(angle), np.sin(angle)])])
    points = disc_m[:, None, None] * ring
    parts = [_moved_by(offset_m, sigma_m, used, points, sigma, bound) for sigma in DISPLACEMENT_M]
    totals = np.stack([total + np.log(share) for (total, _), share in zip(parts, DISPLACEMENT_SHARE, strict=True)])
    likelier = totals.min(axis=2).argmax(axis=0)
    mean = np.stack([mean for _, mean in parts])[likelier, np.arange(len(offset_m))]
    return np.logaddexp(totals[0], totals[1]).min(axis=1), mean


def _moved_by(
    offset_m: Floats, sigma_m: Floats, used: npt.NDArray[np.bool_], points: Floats, displacement_m: float, bound: float
) -> tuple[Floats, Floats]:
    """Ratios against each point of the disc, and the estimated displacement, for one size of displacements."""
    total = np.zeros((len(offset_m), points.shape[1]))
    weight = np.full(len(offset_m), 1.0 / displacement_m**2)
    mean = np.zeros((len(offset_m), 2))
    variance = sigma_m**2
    for k in range(offset_m.shape[1]):
        seen, var = offset_m[:, k], variance[:, k]
        moved = _offset_density(((seen - mean) ** 2).sum(axis=1), var, 1.0 / weight)
        stayed = _offset_density(((seen[:, None, :] - points) ** 2).sum(axis=2), var[:, None], 0.0)
        gain = np.clip(np.log(moved)[:, None] - np.log(stayed), -bound - 2.0, bound)
        total += np.where(used[:, k, None], gain, 0.0)
        # an outlier moves the estimate little: its weight is the probability that it is none
        trust = np.where(used[:, k], 1.0 - _OUTLIER_DENSITY / moved, 0.0)
        added = trust / var
        mean += (added / (weight + added))[:, None] * (seen - mean)
        weight += added
    return total, mean


def missing_gain(
    probability: float, levels: list[float], factors: tuple[float, ...], false_read: float
) -> tuple[float, list[float]]:
    """Log-likelihood ratio of a miss for a marker that is gone, and the probabilities of its factors after the miss.

    Parameters
    ----------
    probability : float
        That this vehicle reads a healthy, clean marker.
    levels, factors : sequence of float
        Probabilities of the factors on it, by the marker's record.
    false_read : float
        That a marker is read that is gone.
    """
    misses = [level * (1.0 - factor * probability) for level, factor in zip(levels, factors, strict=True)]
    total = sum(misses)
    return float(np.log1p(-false_read) - np.log(total)), [miss / total for miss in misses]


def after_reading(levels: list[float], factors: tuple[float, ...]) -> list[float]:
    """Probabilities of the factors after a reading."""
    reads = [level * factor for level, factor in zip(levels, factors, strict=True)]
    total = sum(reads)
    return [read / total for read in reads]


def shift_gain(value: float, shift: float, variance: float) -> float:
    """Log-likelihood ratio of a normal value that is shifted. [nat]"""
    return shift * (value - 0.5 * shift) / variance

"""Parameters of the models by maximum likelihood, with weak priors where a few hundred passes leave them open."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logsumexp

from app.markers.magnet import Installation, Orientation
from app.planning.magnet_checks import magnet_recall
from app.planning.predict.rates import MagnetModel, PathModel, PlateModel, normal_quadrature
from app.values import Floats
from benchmarks.planning.fit.observe import LineSeen, PathSeen, PlatePassSeen, TagPassSeen

NIGHT_EXPOSURES_S = tuple(float(f"{0.002 + 0.006 * (k + 0.5) / 4:.5f}") for k in range(4))
"""Four equally likely exposures by night. Source: `at_night` of app/simulation/conditions.py, 1/500 to 1/125 s."""
_TINY = 1e-12  # of probabilities, so that logarithms are finite
_ASTRAY = 1.5  # squared error over its mean; source: by hand, with it the lower 95 % of the fitted drives are met
_ROBUST = NormalDist().inv_cdf(0.975)  # the 95th percentile of an error over its standard deviation on one axis


def fit_plates(seen: Sequence[PlatePassSeen], exposures_s: tuple[float, ...] = ()) -> PlateModel:
    """Maximum likelihood of all frames, with what the passes have in common integrated out.

    Notes
    -----
    A pass can be read at all with a share that falls with the blur. If it can, its frames are read independently, with
    log-odds that differ between passes by a normal variable.
    """
    passes = [
        (one.blur_units, np.array([px for px, _ in one.frames]), np.array([read for _, read in one.frames]))
        for one in seen
        if one.frames
    ]
    nodes, weights = normal_quadrature()

    def loss(t: Floats) -> float:
        model = _plate_model(t)
        total = 0.0
        for blur, height, read in passes:
            odds = model.pass_log_odds(height, blur)[:, None] + model.spread * nodes
            each = np.where(read[:, None], -np.logaddexp(0, -odds), -np.logaddexp(0, odds)).sum(axis=0)
            share = float(model.readable_share(blur))
            found = math.log(share + _TINY) + float(logsumexp(each, b=weights))
            if not read.any():
                found = float(np.logaddexp(found, math.log(1 - share + _TINY)))
            total -= found
        return total + float((((t - _PRIOR_MEAN) / _PRIOR_SD) ** 2).sum()) / 2

    found = minimize(loss, _PRIOR_MEAN, method="Nelder-Mead", options={"maxfev": 4000, "xatol": 1e-3, "fatol": 1e-3})
    model = _plate_model(found.x)
    fixes = np.array([one.fix_m for one in seen if one.fix_m is not None])
    rms = float(np.percentile(fixes, 95)) / _ROBUST * math.sqrt(2)  # two axes
    return _rounded_plates(model, rms, exposures_s)


_PRIOR_MEAN = np.array([math.log(5.0), 0.0, math.log(0.25), 0.0, 6.0, 0.9])
_PRIOR_SD = np.array([0.7, 0.4, 0.7, 0.7, 4.0, 1.0])  # source: by hand, wide: a factor of two or more either way


def _plate_model(t: Floats) -> PlateModel:
    slope, unit_px, blur_slope, spread, limit = (math.exp(float(t[k])) for k in (0, 1, 2, 3, 5))
    return PlateModel(slope, unit_px, blur_slope, spread, float(t[4]), limit, 0.0)


def _rounded_plates(model: PlateModel, fix_rms_m: float, exposures_s: tuple[float, ...]) -> PlateModel:
    return PlateModel(
        slope=round(model.slope, 4),
        unit_px=round(model.unit_px, 4),
        blur_slope=round(model.blur_slope, 4),
        spread=round(model.spread, 4),
        sharp=round(model.sharp, 4),
        blur_limit=round(model.blur_limit, 4),
        fix_rms_m=round(fix_rms_m, 4),
        exposures_s=exposures_s,
    )


def fit_tags(seen: Sequence[TagPassSeen]) -> MagnetModel:
    """What tags are read beside the share of their magnets that is read at their distance."""
    recall = magnet_recall(Orientation.FORWARD)
    distance = np.array([Installation().distance_m(one.clearance_m) for one in seen])
    magnets = np.array([recall.share_at(d) ** one.magnets for d, one in zip(distance.tolist(), seen, strict=True)])
    bend, read = (np.array([getattr(one, name) for one in seen], float) for name in ("curvature_per_m", "read"))
    fixes = [one.fix_m for one in seen if one.fix_m is not None]
    rms = math.sqrt(sum(fix**2 for fix in fixes) / len(fixes))
    values = _logistic(magnets, distance, bend, read, np.ones(len(seen)))
    return MagnetModel(*values, round(len(fixes) / float(read.sum()), 4), round(rms, 4))


def fit_lines(seen: Sequence[LineSeen]) -> MagnetModel:
    """The same of the magnets of lines under the bar."""
    recall = magnet_recall(Orientation.UP)
    distance = np.array([Installation().distance_m(one.clearance_m) for one in seen])
    magnets = np.array([recall.share_at(d) for d in distance.tolist()])
    bend, read, passed = (
        np.array([getattr(one, name) for one in seen], float) for name in ("curvature_per_m", "read", "magnets")
    )
    return MagnetModel(*_logistic(magnets, distance, bend, read, passed))


def _logistic(
    magnets: Floats, distance: Floats, bend: Floats, read: Floats, passed: Floats
) -> tuple[float, float, float]:
    """Log-odds and their change with distance and curvature, of what is read times the share of the magnets read."""
    prior = np.array([3.0, 20.0, 100.0])  # source: by hand, standard deviations about 4, 0 and 0

    def loss(t: Floats) -> float:
        rate = np.clip(magnets * expit(t[0] + t[1] * (distance - 0.16) + t[2] * bend), _TINY, 1 - _TINY)
        seen = read * np.log(rate) + (passed - read) * np.log(1 - rate)
        return float((((t - (4.0, 0.0, 0.0)) / prior) ** 2).sum()) / 2 - float(seen.sum())

    found = minimize(loss, np.array([4.0, 0.0, 0.0]), method="Nelder-Mead", options={"maxfev": 2000})
    straight, slope, bent = (round(float(value), 4) for value in found.x)
    return straight, min(slope, 0.0), min(bent, 0.0)  # neither distance nor bends help


def fit_path(seen: Sequence[PathSeen]) -> PathModel:
    """Squared error's mean, which the drives scatter about in proportion to it.

    A drive far above the mean counts by the logarithm of its squared error (as Huber's loss by its size): the rare path
    that goes astray says little of the others.
    """
    survey, spacing, speed, exact, ends, rms = (
        np.array([getattr(one, name) for one in seen])
        for name in ("survey_m", "spacing_m", "speed_m_s", "exact_rms_m", "ends_per_m", "rms_m")
    )

    def model(t: Floats) -> PathModel:
        return PathModel(math.exp(t[0]), math.exp(t[1]), float(t[2]), float(t[3]), math.exp(t[4]), math.exp(t[5]), 0.0)

    def loss(t: Floats) -> float:
        one = model(t)
        mean = np.empty(len(seen))
        for value in np.unique(survey):
            own = survey == value
            mean[own] = one.rms_of(float(value), spacing[own], speed[own], exact[own], ends[own]) ** 2
        prior = (float(t[4]) + 3.0) ** 2 + (float(t[5]) - 3.0) ** 2  # source: by hand, wide
        over = rms**2 / mean
        over = np.where(over > _ASTRAY, _ASTRAY * (1.0 + np.log(np.maximum(over, _ASTRAY) / _ASTRAY)), over)
        return float((np.log(mean) + over).sum()) + prior / 8

    start = np.array([math.log(0.008), math.log(0.6), 0.4, -0.2, -3.0, 3.0])
    found = minimize(loss, start, method="Nelder-Mead", options={"maxfev": 6000, "xatol": 1e-4, "fatol": 1e-4})
    best = model(found.x)
    worst = float(np.mean([one.worst_m / one.rms_m for one in seen]))
    values = (
        best.exact_markers_m, best.marker_gain, best.spacing_power, best.speed_power, best.exact_share,
        best.end_gain_m, worst,
    )  # fmt: skip
    return PathModel(*(round(value, 5) for value in values))

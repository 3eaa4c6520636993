"""Second looks at the dipoles of a region, whose fields merge where the bar is high above them.

What was fitted one by one may be a wrong minimum: two magnets of a tag, half a metre apart, as one between them, or as
three; a magnet abreast of one of a line as one of the other kind. Dipoles that are hardly magnets are replaced by one
or two magnets where these are likelier.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.dipole_fit import FORWARD, UPRIGHT, MagnetPrior
from app.decoders.magnet.fit_window import SURE_MARGIN, Dipole, FitWindow

Floats = npt.NDArray[np.float64]

CLUSTER_M = 1.2
"""Largest distance in a cluster, whose fields overlap. [m] Source: chosen by hand."""
MAX_POLISHED = 6
"""Dipoles that are fitted together at most in the end. Source: chosen by hand for speed: a fit grows with the
square."""
PENALTY, CLOSE_PENALTY = 30.0, 30.0
"""Cost of each further magnet when numbers of magnets are compared, and of two that stand too close.
[chi-squared] Source: chosen by hand, near the detection threshold."""
CLOSE_M = 0.42
"""Distance along the road below which two magnets stand too close. [m] Source: `MIN_GAP_M` of 0.5 m, METRO figure 17a,
less the error of two places."""
PAIR_HEIGHT_M, PAIR_ALONE_M, PAIR_HALF_GAP_M = 0.25, 0.8, 0.27
"""A dipole at least so deep, and without another so near along the road, may be two opposed ones at this distance on
each side. [m] Source: `MIN_GAP_M` of 0.5 m; from half of that depth on the fields of both merge."""
PAIR_ALONE_SHARE = 0.2
"""Dipoles near it that explain less than this share of its energy may be the residual of one dipole fitted to two.
Source: by hand."""
PAIR_PENALTY = 15.0
"""Cost of two magnets in place of one. [chi-squared] Source: the pair costs 9 less at most at 261 single magnets of
nine scenes of `benchmarks.hunt.magnet`, and 27 and 59 less at two pairs."""
DOUBT_COST, DOUBT_MARGIN, DOUBT_HEIGHT_M = 2.0, 10.0, 0.2
"""Prior cost from which on, and margin up to which, a dipole so deep may be explained wrongly. [chi-squared,
chi-squared, m] Source: of the dipoles in place of which there were other magnets (120 scenes of
`benchmarks.magnets.drawn_scenes.draw_line_beside_tags`), all had a cost of 2.1 or more, and so have few magnets."""
MAX_DOUBTFUL = 2
"""Groups of them in a region that are explained again. Source: bounds the delay of a streamed trace, `python -m
benchmarks.magnets speed`; with 4, as many tags are read."""
TOGETHER_M = 1.1
"""Dipoles nearer along the road are fitted together. [m] Source: by hand."""
TAG_WIDTH_M = 0.15
"""Width of a row of magnets that can be a tag. [m] Source: chosen by hand, a vehicle that heads 2 degrees off over 4
m."""
MIN_GAIN = 10.0
"""What a replacement must cost less. [chi-squared] Source: chosen by hand; wrong minima cost 30 to 150 more."""


def reconsider(window: FitWindow, prior: MagnetPrior, found: list[Dipole]) -> list[Dipole]:
    """The dipoles of a region, those replaced that are likelier to be others.

    Parameters
    ----------
    window : FitWindow
        About the region.
    prior : MagnetPrior
        What magnets are expected to be like.
    found : list of Dipole
        Each cluster of them fitted together.
    """
    found = _with_kinds_of_moments(window, found)
    for group in _doubtful_groups(found)[:MAX_DOUBTFUL]:
        found = _explain_again(window, prior, found, group)
    return _with_pairs(window, found)


def _with_kinds_of_moments(window: FitWindow, found: list[Dipole]) -> list[Dipole]:
    """Fit dipoles as the kind that their moments show, where that is likelier.

    One that was found before a magnet beside it may have been taken for the other kind; fitted together with that
    magnet, it finds its moment but keeps the kind.
    """
    for cluster in clusters(found):
        kinds = [kind_of_moment(d) for d in cluster]
        if kinds == [d.kind for d in cluster] or len(cluster) > MAX_POLISHED:
            continue
        others = [d for d in found if all(d is not c for c in cluster)]
        fitted = window.fit([d.params for d in cluster], kinds, others)
        if fitted is None:
            continue
        span = float(cluster[0].params[0]), float(cluster[-1].params[0])
        margin = window.cost(found, *span) - window.cost([*others, *fitted], *span)
        if margin > 0:
            pairs = zip(cluster, fitted, strict=True)
            found = others + [replace(f, margin=d.margin if f.kind == d.kind else margin) for d, f in pairs]
    return found


def _doubtful_groups(found: list[Dipole]) -> list[list[Dipole]]:
    """Dipoles that are hardly magnets, unsure of their kind or too near to another; in groups of a row each."""
    groups: list[list[Dipole]] = []
    for dipole in sorted((d for d in found if d.params[2] > DOUBT_HEIGHT_M), key=lambda d: float(d.params[0])):
        s, y = dipole.params[:2]
        row = [d for d in found if d is not dipole and abs(d.params[1] - y) < TAG_WIDTH_M]
        too_near = any(abs(d.params[0] - s) < CLOSE_M for d in row)
        if dipole.prior_cost < DOUBT_COST and dipole.margin > DOUBT_MARGIN and not too_near:
            continue
        for group in groups:
            if s - group[0].params[0] < PAIR_ALONE_M and abs(group[0].params[1] - y) < TAG_WIDTH_M:
                group.append(dipole)
                break
        else:
            groups.append([dipole])
    return groups


def _explain_again(window: FitWindow, prior: MagnetPrior, found: list[Dipole], group: list[Dipole]) -> list[Dipole]:
    """Replace a group by one or two magnets of one kind, if these are likelier; else renew the margin of its kind."""
    s, y = (float(np.mean([d.params[k] for d in group])) for k in (0, 1))
    rest = [d for d in found if all(d is not g for g in group)]
    beside = sorted((d for d in rest if abs(d.params[0] - s) < TOGETHER_M), key=lambda d: abs(float(d.params[0]) - s))[
        :1
    ]
    far = [d for d in rest if all(d is not b for b in beside)]
    places = [s - PAIR_HALF_GAP_M, s + PAIR_HALF_GAP_M, *(float(d.params[0]) for d in (*group, *beside))]
    span = min(places), max(places)

    def cost(dipoles: list[Dipole]) -> float:
        return window.cost(dipoles, *span) + penalty(dipoles)

    trials = []
    for shifts, kind in _alternatives(group):
        starts = [np.array([s + shift, y, prior.clearance_m, 0.0, 0.0, 0.0]) for shift in shifts]
        new = window.fit(starts, [kind] * len(starts), rest)
        if new is not None and (len(new) == 1 or apart_m(new[0].params, new[1].params) > CLOSE_M):
            trials.append((cost([*rest, *new]), new))
    least = min((c for c, _ in trials), default=0.0)
    options: list[tuple[float, int, list[Dipole], list[Dipole]]] = []
    for trial_cost, new in trials:
        if not beside or trial_cost > least + SURE_MARGIN:
            options.append((trial_cost, new[0].kind, new, beside))
        elif fitted := window.fit([d.params for d in (*new, *beside)], [d.kind for d in (*new, *beside)], far):
            again = [replace(fitted[-1], margin=beside[0].margin)]
            options.append((cost([*far, *fitted]), new[0].kind, fitted[:-1], again))
    if not options:
        return found
    now = cost(found)
    best_cost, kind, new, again = min(options, key=lambda option: option[0])
    other_kind = [c for c, k, _, _ in options if k != kind]
    own_kinds = {d.kind for d in group}
    if best_cost < now - MIN_GAIN:
        others = [*other_kind, *([] if own_kinds == {kind} else [now])]
        margin = min(others, default=best_cost) - best_cost
        return [*far, *again, *(replace(d, margin=margin) for d in new)]
    if len(own_kinds) == 1:
        margin = max(min((c for c, k, _, _ in options if k not in own_kinds), default=now) - now, 0.0)
        return [replace(d, margin=margin) if any(d is g for g in group) else d for d in found]
    return found


def _alternatives(group: list[Dipole]) -> list[tuple[tuple[float, ...], int]]:
    """Places along the road, about the group's middle, and the kind of what may be there instead."""
    one: list[tuple[tuple[float, ...], int]] = [((0.0,), kind) for kind in (FORWARD, UPRIGHT)]
    two: list[tuple[tuple[float, ...], int]] = [
        ((-PAIR_HALF_GAP_M, PAIR_HALF_GAP_M), kind) for kind in (FORWARD, UPRIGHT)
    ]
    if len(group) > 1:
        return one + two
    other = [(places, kind) for places, kind in one if kind != group[0].kind]
    return other if group[0].prior_cost < DOUBT_COST else other + two


def _with_pairs(window: FitWindow, found: list[Dipole]) -> list[Dipole]:
    """Replace a dipole by two opposed ones of the other kind where these fit better, or lower its margin.

    Two opposed magnets half a metre apart, as in a tag, have almost the field of one of the other kind between them
    where the bar is high above them.
    """
    for dipole in sorted(found, key=lambda d: -d.explained):
        s, y, h = (float(p) for p in dipole.params[:3])
        near = [d for d in found if d is not dipole and abs(d.params[0] - s) < PAIR_ALONE_M]
        alone = all(d.explained < PAIR_ALONE_SHARE * dipole.explained for d in near)
        if h < PAIR_HEIGHT_M or not alone or all(d is not dipole for d in found):
            continue
        rest = [d for d in found if d is not dipole and all(d is not n for n in near)]
        kind = FORWARD if dipole.kind == UPRIGHT else UPRIGHT
        starts = [np.array([s + shift, y, h, 0.0, 0.0, 0.0]) for shift in (-PAIR_HALF_GAP_M, PAIR_HALF_GAP_M)]
        pair = window.fit(starts, [kind, kind], rest)
        if pair is None:
            continue
        span = s - PAIR_ALONE_M, s + PAIR_ALONE_M
        margin = window.cost([*rest, *pair], *span) + PAIR_PENALTY - window.cost(found, *span) - PENALTY * len(near)
        if margin > 0:
            found = [d if d is not dipole else replace(d, margin=min(d.margin, margin)) for d in found]
        elif apart_m(pair[0].params, pair[1].params) < CLOSE_M:
            found = [d if d is not dipole else replace(d, margin=0.0) for d in found]
        else:
            found = rest + [replace(d, margin=-margin) for d in pair]
    return found


def clusters(dipoles: list[Dipole]) -> list[list[Dipole]]:
    """Groups of dipoles with less than `CLUSTER_M` from each to the next."""
    groups: list[list[Dipole]] = []
    for dipole in sorted(dipoles, key=lambda d: float(d.params[0])):
        if groups and dipole.params[0] - groups[-1][-1].params[0] < CLUSTER_M:
            groups[-1].append(dipole)
        else:
            groups.append([dipole])
    return groups


def kind_of_moment(dipole: Dipole) -> int:
    """The kind within 45 degrees of whose axis the moment is; without any, that as which it was fitted."""
    moment = dipole.params[3:]
    other = FORWARD if dipole.kind == UPRIGHT else UPRIGHT
    return other if 2 * moment[other] ** 2 > moment @ moment else dipole.kind


def penalty(dipoles: list[Dipole]) -> float:
    """Cost of the number of dipoles, and of those that stand too close."""
    places = np.sort([float(d.params[0]) for d in dipoles])
    return PENALTY * len(dipoles) + CLOSE_PENALTY * int(np.sum(np.diff(places) < CLOSE_M))


def apart_m(one: Floats, other: Floats) -> float:
    """Horizontal distance between the places of two dipoles, of their parameters. [m]"""
    return float(np.hypot(one[0] - other[0], one[1] - other[1]))

"""Detection of the dipoles of a region: matching pursuit with joint fits.

The strongest candidate of the matched filters is fitted together with the dipoles near it, its field is taken out of
the bins, the bins are scored again, and so on until nothing exceeds the threshold (orthogonal matching pursuit: Pati,
Rezaiifar and Krishnaprasad, 1993). Clusters whose kinds are unclear are then explained by magnets of one kind.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from app.decoders.magnet.classify import is_ferrous
from app.decoders.magnet.dipole_fit import FORWARD, PARAMETERS, UPRIGHT, MagnetPrior, add_dipole_field
from app.decoders.magnet.fit_window import SURE_MARGIN, Dipole, FitWindow, Region, SensorArray
from app.decoders.magnet.matched_filter import BIN_M, HALF_BINS, THRESHOLD, BinScores, FilterBank, score_bins
from app.decoders.magnet.preprocess import Blocks
from app.values import Floats, Floats32

# === Second looks at the dipoles of a region, whose fields merge where the bar is high above them.
#
# What was fitted one by one may be a wrong minimum: two magnets of a tag, half a metre apart, as one between them, or
# as three; a magnet abreast of one of a line as one of the other kind. Dipoles that are hardly magnets are replaced by
# one or two magnets where these are likelier.


CLUSTER_M = 1.2
"""Largest distance in a cluster, whose fields overlap. [m]"""
MAX_POLISHED = 6
"""Dipoles that are fitted together at most in the end. For speed: a fit grows with the square."""
PENALTY, CLOSE_PENALTY = 30.0, 30.0
"""Cost of each further magnet when numbers of magnets are compared, and of two that stand too close. [chi-squared] Near
the detection threshold."""
CLOSE_M = 0.42
"""Distance along the road below which two magnets stand too close. [m] Source: `MIN_GAP_M` of 0.5 m, METRO figure 17a,
less the error of two places."""
PAIR_HEIGHT_M, PAIR_ALONE_M, PAIR_HALF_GAP_M = 0.25, 0.8, 0.27
"""A dipole at least so deep, and without another so near along the road, may be two opposed ones at this distance on
each side. [m] Source: `MIN_GAP_M` of 0.5 m; from half of that depth on the fields of both merge."""
PAIR_ALONE_SHARE = 0.2
"""Dipoles near it that explain less than this share of its energy may be the residual of one dipole fitted to two."""
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
"""Dipoles nearer along the road are fitted together. [m]"""
TAG_WIDTH_M = 0.15
"""Width of a row of magnets that can be a tag. [m] A vehicle that heads 2 degrees off over 4 m."""
MIN_GAIN = 10.0
"""What a replacement must cost less. [chi-squared] Wrong minima cost 30 to 150 more."""


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


# === Detection of the dipoles of a region.


STOP_SHARE = 0.015
"""Share of the strongest candidate's statistic below which the pursuit ends: what a model that errs by some percent
leaves of a strong magnet."""
MAX_MAGNETS = 12
"""Dipoles of a region at most. A region of 8 m holds two tags of METRO's seven magnets at most."""
CLUSTER_MARGIN_M = 0.6
"""Road beyond a cluster that is scored again. [m]"""
FERROUS_COUNT = 4
"""Number of dipoles after which, and after twice of which, a region is examined for iron."""
MAX_FAILED = 3
"""Fits that do not confirm what the filters saw, after which a region counts as iron."""
MAX_JOINT_FITS, ROW_WIDTH_M = 12, 0.3
"""Joint fits that a region may take if its dipoles do not stand in a row so narrow. [1, m] Source: bounds the delay of
a streamed trace, `python -m benchmarks.magnets speed`."""
MAX_TOGETHER = 3
"""Dipoles that are fitted together with a new one, with it."""
SAME_M = 0.3
"""Dipoles nearer than this are one. [m] Well below `MIN_GAP_M`."""
CONFIRMED_SHARE = 0.5
"""Share of the threshold that a fit must explain to confirm its candidate."""
KNOWN_BINS, REFUSED_BINS = 2, 3
"""Bins on each side that are not tried again after a candidate was a known dipole, or its fit was refused."""
START_BINS = 8
"""Bins on each side in which the other kind's best start is looked for: 40 cm. An upright magnet's forward field peaks
half a height from it."""
TRACKED_STD_M = 0.08
"""A clearance known better than this is the start of fits. [m] Between `CLEARANCE_STD_M` and the estimated one."""
FIELD_M = 2.0
"""Reach of a dipole's field in the bins. [m] The filters reach 1.2 m."""
CHANGE_M, CHANGE_HEIGHTS = 0.9, 3.0
"""Reach of what a dipole changes in the filters' results: metres, and heights more. For speed."""


@dataclass(slots=True, eq=False)
class DipoleDetector:
    """Detects the dipoles of regions."""

    bank: FilterBank
    array: SensorArray

    def detect(self, blocks: Blocks, region: Region, prior: MagnetPrior) -> list[Dipole]:
        """Dipoles of a region.

        Lines and tags keep apart, so clusters of mixed or unclear kinds are also explained by one kind alone.
        """
        pursuit = _Pursuit(self.bank, self.array, region, prior, FitWindow(self.array, blocks, region, prior))
        found, ferrous = pursuit.run((FORWARD, UPRIGHT), [])
        if ferrous:
            return found
        for cluster in clusters(found):
            if pursuit.is_slow(found):
                break
            if _is_unclear(cluster) and 2 * sum(d.unlike_magnet for d in cluster) <= len(cluster):
                found = self._fit_one_kind(pursuit, found, cluster)
        return reconsider(pursuit.window, prior, pursuit.polish(found))

    def _fit_one_kind(self, pursuit: _Pursuit, found: list[Dipole], cluster: list[Dipole]) -> list[Dipole]:
        """Explain a cluster by magnets of one kind, if that is as likely."""
        others = [d for d in found if all(d is not c for c in cluster)]
        places = [float(d.params[0]) for d in cluster]
        span = min(places), max(places)
        part = pursuit.between(span[0] - CLUSTER_MARGIN_M, span[1] + CLUSTER_MARGIN_M)
        costs = [(pursuit.window.cost(found, *span) + penalty(found), found)]
        for kind in (FORWARD, UPRIGHT):
            if any(d.kind != kind for d in cluster):
                whole = others + part.run((kind,), others)[0]
                if all(kind_of_moment(d) == d.kind for d in whole):
                    costs.append((pursuit.window.cost(whole, *span) + penalty(whole), whole))
        costs.sort(key=lambda c: c[0])
        best = costs[0][1]
        own = [d for d in best if all(d is not o for o in others)]
        if len(costs) == 1 or len({d.kind for d in own}) > 1:
            return best
        margin = costs[1][0] - costs[0][0]  # of the kind that they share
        return others + [replace(d, margin=max(d.margin, margin)) for d in own]


@dataclass(slots=True, eq=False)
class _Residual:
    """What the dipoles found so far leave of a region: bins and their scores."""

    x: Floats32
    scores: BinScores

    def best(self, columns: list[int]) -> tuple[int, float]:
        """Bin with the largest statistic of some kinds, and the statistic."""
        k = int(np.argmax(self.scores.statistic[:, columns].max(axis=1)))
        return k, float(self.scores.statistic[k, columns].max())

    def discard(self, k: int, bins: int) -> None:
        """Try no more candidates so near to bin k."""
        self.scores.statistic[max(k - bins, 0) : k + bins + 1] = 0


@dataclass(slots=True, eq=False)
class _Candidate:
    """Where a magnet may be: the bin, the start of a fit as each kind (the likelier first), and who is fitted again."""

    bin: int
    starts: dict[int, Floats]
    group: list[int]

    @property
    def start(self) -> Floats:
        """Start as the likelier kind."""
        return next(iter(self.starts.values()))


@dataclass(slots=True, eq=False)
class _Pursuit:
    """The matching pursuit over one region, or over a part of it."""

    bank: FilterBank
    array: SensorArray
    region: Region
    prior: MagnetPrior
    window: FitWindow
    _failed: int = field(default=0, init=False)

    def between(self, start_m: float, end_m: float) -> _Pursuit:
        """The same over the part between two distances."""
        first = self.region.start + HALF_BINS
        count = len(self.region.scores.statistic)
        a = min(max(int(start_m / BIN_M) - first, 0), count - 1)
        b = min(max(int(end_m / BIN_M) - first, a), count - 1)
        part = replace(
            self.region,
            x=self.region.x[a : b + 1 + 2 * HALF_BINS],
            start=self.region.start + a,
            scores=self.region.scores.part(a, b + 1),
        )
        return replace(self, region=part)

    def run(self, kinds: tuple[int, ...], known: list[Dipole]) -> tuple[list[Dipole], bool]:
        """Dipoles of some kinds that explain what known ones leave of the region, the strongest first.

        Returns
        -------
        list of Dipole, bool
            And whether the region is iron, of which further poles would only take time.
        """
        scores = self.region.scores
        left = _Residual(self.region.x.copy(), BinScores(scores.statistic.copy(), scores.cell.copy()))
        if known:
            self._subtract(left, known, [])
        columns = [0 if kind == FORWARD else 1 for kind in kinds]
        found: list[Dipole] = []
        strongest = 0.0
        self._failed = 0
        while len(found) < MAX_MAGNETS:
            k, best = left.best(columns)
            strongest = max(strongest, best)
            if best < max(THRESHOLD, STOP_SHARE * strongest):
                break
            candidate = self._candidate(k, kinds, columns, left, found)
            if any(apart_m(d.params, candidate.start) < SAME_M for d in found):
                left.discard(k, KNOWN_BINS)  # what the model of that dipole missed
                continue
            before, failed = [found[i] for i in candidate.group], self._failed
            fitted = self._fit(candidate, found, known, left)
            if fitted is not None:
                found = self._with_fitted(found, candidate.group, fitted)
                found, ferrous = self._examine(found)
                if ferrous:
                    return found, True
                self._subtract(left, fitted, before)
            elif self._failed > failed and self._is_hopeless(found):
                return found, True
        return found, False

    def _candidate(
        self, k: int, kinds: tuple[int, ...], columns: list[int], left: _Residual, found: list[Dipole]
    ) -> _Candidate:
        """The candidate at bin k."""
        order = sorted(zip(kinds, columns, strict=True), key=lambda c: -float(left.scores.statistic[k, c[1]]))
        starts = {kind: self._start(k, column, left.scores) for kind, column in order}
        s = starts[order[0][0]][0]
        near = sorted(range(len(found)), key=lambda i: abs(found[i].params[0] - s))[: MAX_TOGETHER - 1]
        return _Candidate(k, starts, [i for i in near if abs(found[i].params[0] - s) < TOGETHER_M])

    def _start(self, k: int, column: int, scores: BinScores) -> Floats:
        """Where a magnet of a kind fits best near bin k."""
        statistic = scores.statistic
        low, at = max(k - START_BINS, 0), k
        if statistic[k, column] < statistic[k].max():
            at = low + int(np.argmax(statistic[low : k + START_BINS + 1, column]))
        start = np.zeros(PARAMETERS)
        start[0] = (self.region.start + HALF_BINS + at + 0.5) * BIN_M
        start[1] = self.bank.lateral_m[scores.cell[at, column]]
        tracked = self.prior.clearance_std_m < TRACKED_STD_M
        start[2] = self.prior.clearance_m if tracked else self.bank.height_m[scores.cell[at, column]]
        return start

    def _fit(
        self, candidate: _Candidate, found: list[Dipole], known: list[Dipole], left: _Residual
    ) -> list[Dipole] | None:
        """The candidate's group and its dipole, fitted together; None if that does not confirm the candidate."""
        group = [found[i] for i in candidate.group]
        others = [d for i, d in enumerate(found) if i not in candidate.group] + known
        fitted = self.window.fit_either_kind(group, candidate.starts, others)
        if fitted is None:
            left.discard(candidate.bin, 0)
            return None
        added = fitted[-1]
        same = any(apart_m(d.params, added.params) < SAME_M for d in fitted[:-1])
        if added.explained < CONFIRMED_SHARE * THRESHOLD or same:
            left.discard(candidate.bin, REFUSED_BINS)
            self._failed += 1
            return None
        return fitted

    def _is_hopeless(self, found: list[Dipole]) -> bool:
        """Whether the region is iron because too many fits were refused, or they take too long."""
        return (self._failed >= MAX_FAILED and self._failed > len(found)) or self.is_slow(found)

    def _with_fitted(self, found: list[Dipole], group: list[int], fitted: list[Dipole]) -> list[Dipole]:
        """The dipoles with a group fitted again, each with its margin, and the new one."""
        out = list(found)
        for i, dipole in zip(group, fitted, strict=False):
            out[i] = replace(dipole, margin=found[i].margin)
        return [*out, fitted[-1]]

    def _examine(self, found: list[Dipole]) -> tuple[list[Dipole], bool]:
        """Whether the dipoles so far are poles of iron; they may be polished to find out."""
        if is_ferrous(found, self.array.half_width_m) or self.is_slow(found):
            return found, True
        if len(found) in (FERROUS_COUNT, 2 * FERROUS_COUNT) and _mostly_unlike(found):
            found = self.polish(found)
            return found, _mostly_unlike(found) and not _is_row(found)
        return found, False

    def is_slow(self, found: list[Dipole]) -> bool:
        """Whether the fits took so long that only a row of magnets is worth more."""
        width = np.ptp([d.params[1] for d in found]) if found else 0.0
        return bool(self.window.joint_fits > MAX_JOINT_FITS and width > ROW_WIDTH_M)

    def polish(self, found: list[Dipole]) -> list[Dipole]:
        """Fit the dipoles of each cluster together: those found first were fitted without the others."""
        for cluster in (c for c in clusters(found) if len(c) > 1):
            for k in range(0, len(cluster), MAX_POLISHED):
                part = cluster[k : k + MAX_POLISHED]
                others = [d for d in found if all(d is not p for p in part)]
                fitted = self.window.fit([d.params for d in part], [d.kind for d in part], others)
                if fitted:
                    found = others + [replace(f, margin=d.margin) for f, d in zip(fitted, part, strict=True)]
        return found

    def _subtract(self, left: _Residual, add: list[Dipole], undo: list[Dipole]) -> None:
        """Take the fields of dipoles out of the bins, put earlier fits of them back, and score the bins again."""
        x, share = left.x, self.region.common_share
        middles: Floats = (self.region.start + np.arange(len(x), dtype=float) + 0.5) * BIN_M
        rows = x.reshape(len(x), -1, 3)
        for sign, dipoles in ((-1.0, add), (1.0, undo)):
            for dipole in dipoles:
                s = dipole.params[0]
                low, high = np.searchsorted(middles, (s - FIELD_M, s + FIELD_M))
                add_dipole_field(dipole.params, middles[low:high], self.array.positions_m, sign, share, rows[low:high])
        changed = [d.params for d in (*add, *undo)]
        first = self.region.start + HALF_BINS
        start_m = min(p[0] - CHANGE_M - CHANGE_HEIGHTS * p[2] for p in changed)
        end_m = max(p[0] + CHANGE_M + CHANGE_HEIGHTS * p[2] for p in changed)
        a = max(int(start_m / BIN_M) - first, 0)
        b = min(int(end_m / BIN_M) - first + 1, len(left.scores.statistic))
        if a < b:
            score_bins(x, HALF_BINS + a, self.bank, self.region.variance, left.scores.part(a, b))


def _is_unclear(cluster: list[Dipole]) -> bool:
    """Whether the kinds of a cluster's dipoles may be others, as their fields overlap."""
    places = [float(d.params[0]) for d in cluster]
    kinds = {d.kind for d in cluster}
    return len(cluster) > 1 and bool(
        len(kinds) > 1 or min(np.diff(places)) < CLOSE_M or min(d.margin for d in cluster) < SURE_MARGIN
    )


def _mostly_unlike(dipoles: list[Dipole]) -> bool:
    """Whether most of the dipoles are unlike magnets."""
    return 2 * sum(d.unlike_magnet for d in dipoles) > len(dipoles)


def _is_row(dipoles: list[Dipole]) -> bool:
    """Whether dipoles stand like the magnets of a tag, apart and one behind the other."""
    places = np.array([d.params[:2] for d in dipoles])
    gap_m = np.diff(np.sort(places[:, 0])).min(initial=np.inf)
    return bool(np.ptp(places[:, 1]) < TAG_WIDTH_M and gap_m > CLOSE_M)


def are_same(one: Dipole, other: Dipole) -> bool:
    """Whether two dipoles are so near to each other that they are one."""
    return apart_m(one.params, other.params) < SAME_M

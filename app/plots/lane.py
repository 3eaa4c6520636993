"""A picture of a decoded lane, as SVG: from above, straightened, its standard deviation, and the signal strength."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import scipy

from app.lanes.smooth_line import plane_from_wgs84
from app.lanes.types import Lane, LaneMarkers
from app.plots.axes import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    Panel,
    Scale,
    area,
    circle,
    cross,
    dots,
    heading,
    nice_step,
    outlined,
    picture,
    polylines,
    shape,
    spans,
    stroke,
    text,
    thin,
    ticks,
)
from app.sensors.pose_track import PoseTrack
from app.values import Floats, Ints

# === The strength of packets over distance, with the fitted path loss, as a panel of an SVG.


PANEL_HEIGHT = 170
_MAX_DOTS = 1500  # packets that are drawn
_NEAR_M, _FAR_M, _HIGH_DBM, _LOW_DBM = 40.0, 400.0, -100.0, -130.0  # always shown, so that pictures compare
_PAPER_POINTS = ((50.0, -108.0), (340.0, -125.0))  # [m, dBm] CERPM paper, section 4.1


@dataclass(frozen=True, slots=True, eq=False)
class SignalPicture:
    """Strength of packets over distance."""

    # `distance_m`, `rssi_dbm`: shape (P,): NaN where either is not known. [m, dBm]
    distance_m: Floats
    rssi_dbm: Floats
    # `at_1m_dbm`, `exponent`: fitted path loss: RSSI = at_1m - 10 exponent log10(distance). [dBm, 1]
    at_1m_dbm: float | None = None
    exponent: float | None = None


def signal_panel(signals: SignalPicture, left: float, right: float, top: float) -> list[str]:
    """RSSI over the logarithm of distance: path loss is a straight line there."""
    kept = np.isfinite(signals.distance_m) & np.isfinite(signals.rssi_dbm) & (signals.distance_m > 0)
    distance, rssi = signals.distance_m[kept], signals.rssi_dbm[kept]
    panel = Panel(left, right, top, top + PANEL_HEIGHT)
    near = max(min(distance.min(initial=_NEAR_M), _NEAR_M), 1.0)
    far = max(distance.max(initial=_FAR_M), _FAR_M)
    high = 10 * math.ceil(max(rssi.max(initial=_HIGH_DBM), _HIGH_DBM) / 10)
    low = 10 * math.floor(min(rssi.min(initial=_LOW_DBM), _LOW_DBM) / 10)
    along, up = Scale(near, far, left, right, np.log), Scale(low, high, panel.bottom, top)
    parts = [panel.frame(), text(left, top - 6, "RSSI over distance; ◇ in the paper", colour=GREY)]
    for dbm in range(low, high + 1, 10 if high - low <= 60 else 20):
        parts.append(panel.line_across(up.at(dbm)))
        parts.append(panel.label_left(up.at(dbm) + 4, f"{dbm} dBm".replace("-", "−")))
    for at_m in (m * 10**e for e in range(5) for m in (1, 2, 5)):
        if near <= at_m <= far:
            parts += panel.tick_below(along.at(at_m), f"{at_m} m")
    thinned = slice(None, None, max(math.ceil(len(distance) / _MAX_DOTS), 1))
    points = np.stack([along.px(distance[thinned]), up.px(rssi[thinned])], axis=-1)
    parts.append(dots(points, BLUE, 4, 0.4))
    for paper_m, paper_dbm in _PAPER_POINTS:
        parts.append(shape(f"M{along.at(paper_m):.1f} {up.at(paper_dbm) - 6:.1f}l6 6l-6 6l-6 -6z", "white", GREY))
    return [*parts, *_fitted(signals, panel, along, up)]


def _fitted(signals: SignalPicture, panel: Panel, along: Scale, up: Scale) -> list[str]:
    """The fitted line, and its figures above the panel."""
    caption = "no path loss fitted"
    parts = []
    if signals.at_1m_dbm is not None and signals.exponent is not None:
        at_m = np.geomspace(along.first, along.last, 60)
        dbm = signals.at_1m_dbm - 10 * signals.exponent * np.log10(at_m)
        parts = polylines(np.stack([along.px(at_m), up.px(dbm)], axis=-1), RED, 1.6)
        level = signals.at_1m_dbm - 10 * signals.exponent * math.log10(50)
        caption = f"fitted: {level:.0f} dBm at 50 m, exponent {signals.exponent:.2f}".replace("-", "−")
    return [*parts, text(panel.right, panel.top - 6, caption, colour=RED, anchor="end")]


# === A picture of a decoded lane, as SVG.


_LONG_M = 3000.0  # [m] longer tracks are not dashed: dashes of a zigzag cannot be seen
_WIDTH, _LEFT, _RIGHT = 1200, 80, 1138  # [px] of the picture, and the sides of its panels
_PLAN_TOP, _MIN_PLAN, _MAX_PLAN = 66, 130, 380  # [px]
_STRIP, _SIGMA = 150, 86  # [px] heights of the panels below the plan
_MIN_M, _MARGIN_PX = (30.0, 6.0), 26
_MAX_LABELS, _MAX_TITLES = 14, 400
_SIDE_COLOURS = {-1: GREY, 0: "#7d3c98", 1: BLUE, 2: ORANGE}
_CENTRE, _TRACK, _OUT = "#2d3e50", GREEN, RED
_CONFIDENCE, _CONFIDENCE_LABEL, _TICK = "#8fb7b2", "#4e8a83", "#aaa"


@dataclass(frozen=True, slots=True, eq=False)
class LanePicture:
    """What a picture of a lane shows; east and north of one origin throughout."""

    # `centre_m`, `left_m`, `right_m`: shape (S, 2): [m] centre line and boundaries, NaN where they are not known; empty
    # where the lane was refused
    centre_m: Floats
    left_m: Floats
    right_m: Floats
    # `station_m`, `sigma_m`, `confidence`: shape (S,)
    station_m: Floats
    sigma_m: Floats
    confidence: Floats
    marker_m: Floats  # shape (K, 2): [m] NaN where a marker has no place
    # `marker_number`, `marker_side`: shape (K,): sides as in `LaneSide`: 0 unknown, 1 left, 2 right; -1 in another lane
    marker_number: Ints
    marker_side: Ints
    left_out: dict[int, str] = field(default_factory=dict)  # why markers were left out, by their row
    # shape (T, 2): [m] where the vehicle drove; may be empty
    track_m: Floats = field(default_factory=lambda: np.empty((0, 2)))
    refusal: str | None = None  # why there is no lane


def picture_of_lane(lane: Lane, markers: LaneMarkers, track: PoseTrack | None = None) -> LanePicture:
    """What to show of a lane and the markers that it was decoded from, in the lane's own plane."""
    origin = (lane.origin_lon_deg, lane.origin_lat_deg)
    earthly = (np.abs(markers.lat_deg) <= 90) & (np.abs(markers.lon_deg) <= 360)
    marker_m = np.full((len(markers), 2), np.nan)
    marker_m[earthly] = plane_from_wgs84(markers.lon_deg[earthly], markers.lat_deg[earthly], origin)
    elsewhere = np.isin(markers.number, list(lane.of_other_lanes))
    return LanePicture(
        lane.position_enu_m,
        lane.left_enu_m,
        lane.right_enu_m,
        lane.station_m,
        lane.sigma_m,
        lane.confidence,
        marker_m,
        markers.number,
        np.where(elsewhere, -1, np.where(lane.side > 0, lane.side, markers.side)),
        {out.row: out.reason.text for out in lane.left_out if not elsewhere[out.row]},
        np.empty((0, 2)) if track is None else plane_from_wgs84(track.lon_deg, track.lat_deg, origin),
        lane.refusal,
    )


def plot_lane(lane: LanePicture, signals: SignalPicture | None = None) -> str:
    """SVG of a lane.

    From top to bottom: the lane from above at one scale, turned so that it lies along the page; the same straightened,
    metres to the left and right of its centre line, so that markers and the track can be seen beside it on long lanes;
    its standard deviation and confidence along the way; RSSI over distance with the fitted line and the paper's two
    points. Markers are blue left, orange right, violet without a side and grey in another lane; those left out are
    crossed out in red, with number and reason.
    """
    view = _plan_view(lane)
    parts = [heading(_LEFT, 20, _title(lane)), _legend(), *_without_position(lane)]
    below: float = _PLAN_TOP
    if view is not None:
        parts += _plan_panel(lane, view)
        below += view.panel.height + 34
    if len(lane.centre_m) > 1:
        strip = Panel(_LEFT, _RIGHT, below, below + _STRIP)
        sigma = Panel(_LEFT, _RIGHT, strip.bottom + 14, strip.bottom + 14 + _SIGMA)
        parts += _strip_panel(lane, strip)
        parts += _sigma_panel(lane, sigma)
        parts += _station_axis(lane, strip, sigma)
        below = sigma.bottom + 50
    if signals is not None:
        below += 0 if len(lane.centre_m) > 1 else 26
        parts += signal_panel(signals, _LEFT, _RIGHT, below)
        below += PANEL_HEIGHT + 44
    return picture(_WIDTH, below, parts)


def _title(lane: LanePicture) -> str:
    out = len(lane.left_out)
    others = int((lane.marker_side == -1).sum())
    used = len(lane.marker_m) - out - others
    markers = f"{used} marker{'s' * (used != 1)}"
    markers += (f", {others} of other lanes" if others else "") + (f", {out} left out" if out else "")
    if len(lane.centre_m) < 2:
        return f"No lane: {lane.refusal or 'no path'}; {markers}"
    length = _length_text(float(lane.station_m[-1] - lane.station_m[0]))
    known = lane.sigma_m[np.isfinite(lane.sigma_m)]
    sure = f"; ± {100 * np.median(known):.1f} cm, at worst ± {100 * known.max():.0f} cm" if len(known) else ""
    return f"Lane of {length}: {markers}{sure}"


def _length_text(length_m: float) -> str:
    return f"{length_m / 1000:.2f} km" if length_m >= 10_000 else f"{length_m:.0f} m"


def _legend() -> str:
    entries = [
        ("● left", _SIDE_COLOURS[1], False), ("● right", _SIDE_COLOURS[2], False),
        ("● no side", _SIDE_COLOURS[0], False), ("● other lane", _SIDE_COLOURS[-1], False), ("✕ left out", _OUT, False),
        ("— centre line", _CENTRE, True), ("‒ ‒ vehicle", _TRACK, False),
    ]  # fmt: skip
    gap = ("     ", "", False)
    return spans(_LEFT, 42, [part for entry in entries for part in (entry, gap)][:-1])


def _without_position(lane: LanePicture) -> list[str]:
    """Markers that were left out and have no position to be drawn at."""
    rows = [row for row in sorted(lane.left_out) if not np.isfinite(lane.marker_m[row]).all()]
    if not rows:
        return []
    named = ", ".join(f"{int(lane.marker_number[row])}: {lane.left_out[row]}" for row in rows[:3])
    more = f" and {len(rows) - 3} more" if len(rows) > 3 else ""
    return [text(_RIGHT, 42, named + more, colour=_OUT, anchor="end", size=11)]


# --- from above ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _PlanView:
    """Where points of the plane are drawn: turned, moved and at one scale for both axes."""

    turn: Floats
    origin: Floats
    scale: float
    panel: Panel

    def px(self, points_m: Floats) -> Floats:
        x, y = ((points_m - self.origin) @ self.turn.T * self.scale).T
        return np.stack([self.panel.left + _MARGIN_PX + x, self.panel.bottom - _MARGIN_PX - y], axis=-1)


def _finite(points_m: Floats) -> Floats:
    return points_m[np.isfinite(points_m).all(axis=1)]


def _plan_view(lane: LanePicture) -> _PlanView | None:
    """One scale for both axes; the lane's longest extent lies along the page, its start on the left."""
    shape = _finite(lane.centre_m) if len(lane.centre_m) > 1 else _finite(lane.marker_m)
    if not len(shape):
        return None
    away = shape - shape.mean(axis=0)
    axis = np.linalg.svd(away, full_matrices=False)[2][0] if len(shape) > 1 else np.array([1.0, 0.0])
    axis = axis if (shape[-1] - shape[0]) @ axis >= 0 else -axis
    turn = np.array([axis, (-axis[1], axis[0])])
    lines = [shape, _finite(lane.left_m), _finite(lane.right_m)]
    markers = _finite(lane.marker_m)
    reach = np.ptp(shape, axis=0).max() * 0.1 + 40.0  # a claim farther off is shown at the border
    if len(markers):
        lines.append(markers[scipy.spatial.cKDTree(shape).query(markers)[0] < reach])
    turned = np.vstack(lines) @ turn.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    extent = np.maximum(high - low, _MIN_M)
    room = np.array([_RIGHT - _LEFT, _MAX_PLAN]) - 2 * _MARGIN_PX
    scale = float((room / extent).min())
    height = int(max(extent[1] * scale + 2 * _MARGIN_PX, _MIN_PLAN))
    spare = np.array([room[0], height - 2 * _MARGIN_PX]) / scale - (high - low)
    panel = Panel(_LEFT, _RIGHT, _PLAN_TOP, _PLAN_TOP + height)
    return _PlanView(turn, (low - spare / 2) @ turn, scale, panel)


def _plan_panel(lane: LanePicture, view: _PlanView) -> list[str]:
    left, right, centre = (view.px(line) for line in (lane.left_m, lane.right_m, lane.centre_m))
    lines = area(left, right)
    for line, colour, width, dash in (
        (left, _SIDE_COLOURS[1], 1.2, ""), (right, _SIDE_COLOURS[2], 1.2, ""),
        (view.px(lane.track_m), _TRACK, 1.2, "6 4"), (centre, _CENTRE, 1.5, ""),
    ):  # fmt: skip
        lines += polylines(line, colour, width, dash)
    return [
        view.panel.frame(),
        *view.panel.clipped("plan", lines),
        *_markers(lane, view.px(lane.marker_m), view.panel, 3.2),
        *_scale_and_north(view),
    ]


def _scale_and_north(view: _PlanView) -> list[str]:
    length = nice_step(120 / view.scale)
    bar, y = length * view.scale, view.panel.bottom + 16
    north = view.turn @ (0.0, 1.0)
    x0, y0 = _RIGHT - 14, y - 4
    dx, dy = 11 * north[0], -11 * north[1]
    head = f"l{-0.6 * dx - 0.35 * dy:.1f} {-0.6 * dy + 0.35 * dx:.1f}l{0.7 * dy:.1f} {-0.7 * dx:.1f}z"
    return [
        stroke(f"M{_LEFT} {y - 8}v5h{bar:.1f}v-5", GREY),
        text(_LEFT + bar + 6, y, _length_text(length), colour=GREY),
        stroke(f"M{x0 - dx:.1f} {y0 - dy:.1f}L{x0 + dx:.1f} {y0 + dy:.1f}", GREY, 1.5),
        shape(f"M{x0 + dx:.1f} {y0 + dy:.1f}{head}", GREY),
        text(x0 - 18, y, "north", colour=GREY, anchor="end"),
    ]


def _markers(lane: LanePicture, at_px: Floats, panel: Panel, size: float) -> list[str]:
    """Dots by side; crosses and labels for what was left out, drawn last and at the border where it lies beyond."""
    inside: npt.NDArray[np.bool_] = np.all(
        (at_px >= (panel.left, panel.top)) & (at_px <= (panel.right, panel.bottom)), axis=1
    )
    inside[list(lane.left_out)] = False
    sides = [_SIDE_COLOURS.get(side, _SIDE_COLOURS[0]) for side in lane.marker_side.tolist()]
    if len(at_px) > _MAX_TITLES:
        wanted = {colour: inside & (np.array(sides) == colour) for colour in _SIDE_COLOURS.values()}
        parts = [dots(at_px[rows], colour, size) for colour, rows in wanted.items()]
    else:
        parts = [
            circle(
                float(at_px[row, 0]), float(at_px[row, 1]), size, sides[row], f"marker {int(lane.marker_number[row])}"
            )
            for row in np.flatnonzero(inside).tolist()
        ]
    return parts + _left_out(lane, at_px, panel)


def _left_out(lane: LanePicture, at_px: Floats, panel: Panel) -> list[str]:
    """Crosses for the markers that were left out, labelled as far as there is room."""
    parts: list[str] = []
    taken: list[_Box] = []
    for row, reason in sorted(lane.left_out.items()):
        x, y = at_px[row].tolist()
        if not math.isfinite(x + y):
            continue
        beyond = not (panel.left <= x <= panel.right and panel.top <= y <= panel.bottom)
        x, y = min(max(x, panel.left + 6), panel.right - 6), min(max(y, panel.top + 6), panel.bottom - 6)
        label = f"{int(lane.marker_number[row])}: {reason}" + (" (beyond)" if beyond else "")
        parts.append(cross(x, y, 4, _OUT, 2.0, f"marker {label}"))
        spot = _free_spot(x, y, 6.4 * len(label), panel, taken) if len(taken) < _MAX_LABELS else None
        if spot is not None:
            taken.append(spot)
            side, anchor = (spot[0], "start") if spot[0] > x else (spot[2], "end")
            parts.append(outlined(side, spot[3] - 3, label, _OUT, anchor))
    return parts


_Box = tuple[float, float, float, float]


def _free_spot(x: float, y: float, width: float, panel: Panel, taken: Sequence[_Box]) -> _Box | None:
    """Room for a label beside a cross: right, left, above or below."""
    for step in (0, 14, -14, 28, -28):
        for x0 in (x + 7, x - 7 - width):
            left, top, right, bottom = spot = (x0, y - 7 + step, x0 + width, y + 7 + step)
            inside = left >= panel.left and top >= panel.top and right <= panel.right and bottom <= panel.bottom
            clear = all(left > t[2] or right < t[0] or top > t[3] or bottom < t[1] for t in taken)
            if inside and clear:
                return spot
    return None


# --- straightened -------------------------------------------------------------------------------------------------


def _beside(lane: LanePicture, points_m: Floats) -> Floats:
    """Station and metres left of the centre line, shape (N, 2); NaN past its ends."""
    out = np.full((len(points_m), 2), np.nan)
    rows = np.flatnonzero(np.isfinite(points_m).all(axis=1))
    if not len(rows):
        return out
    nearest = scipy.spatial.cKDTree(lane.centre_m).query(points_m[rows])[1]
    ahead = np.gradient(lane.centre_m, axis=0)[nearest]
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-12)[:, None]
    offset = points_m[rows] - lane.centre_m[nearest]
    along = np.sum(offset * ahead, axis=1)
    left = ahead[:, 0] * offset[:, 1] - ahead[:, 1] * offset[:, 0]
    ends = (nearest == 0) | (nearest == len(lane.centre_m) - 1)
    kept = ~(ends & (np.abs(along) > 5.0)) | (np.abs(left) > np.abs(along))
    out[rows[kept]] = np.column_stack([lane.station_m[nearest] + along, left])[kept]
    return out


def _left_of_centre(lane: LanePicture, line_m: Floats) -> Floats:
    """Metres left of the centre line of each of its points. [m]"""
    ahead = np.gradient(lane.centre_m, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-12)[:, None]
    offset = line_m - lane.centre_m
    left: Floats = ahead[:, 0] * offset[:, 1] - ahead[:, 1] * offset[:, 0]
    return left


def _along(lane: LanePicture) -> Scale:
    """Stations to pixels."""
    return Scale(float(lane.station_m[0]), float(lane.station_m[-1]), _LEFT, _RIGHT)


def _strip_panel(lane: LanePicture, panel: Panel) -> list[str]:
    sides = [_left_of_centre(lane, line) for line in (lane.left_m, lane.right_m)]
    half_m = float(np.clip(np.nanmax(np.abs(np.concatenate(sides)), initial=1.8) + 1.0, 2.5, 8.0))
    along = _along(lane)

    def px(station_m: Floats, left_m: Floats) -> Floats:
        return np.stack([along.px(station_m), panel.middle - panel.height / 2 * left_m / half_m], axis=-1)

    left, right = (px(lane.station_m, side) for side in sides)
    dash = "6 4" if along.last - along.first < _LONG_M else ""
    lines = [
        *area(left, right),
        *polylines(left, _SIDE_COLOURS[1], 1.2),
        *polylines(right, _SIDE_COLOURS[2], 1.2),
        *polylines(px(*_beside(lane, thin(lane.track_m)).T), _TRACK, 1.2, dash),
        panel.line_across(panel.middle, _CENTRE, 1.5),
    ]
    parts = [panel.frame(), *panel.clipped("strip", lines)]
    step = 1 if half_m < 4 else 2
    for tick in range(-int(half_m), int(half_m) + 1):
        if tick % step == 0:
            label = f"{abs(tick)} m" + (" left" if tick == step else " right" if tick == -step else "")
            parts.append(panel.label_left(panel.middle - panel.height / 2 * tick / half_m + 4, label))
    at = _beside(lane, lane.marker_m)
    return [*parts, *_markers(lane, px(at[:, 0], at[:, 1]), panel, 2.6)]


def _sigma_panel(lane: LanePicture, panel: Panel) -> list[str]:
    """Standard deviation and confidence over the station."""
    known = lane.sigma_m[np.isfinite(lane.sigma_m)]
    full_m = nice_step(1.2 * float(known.max()) if len(known) else 0.1, up=True)
    x = _along(lane).px(lane.station_m)
    sigma = np.stack([x, Scale(0.0, full_m, panel.bottom, panel.top).px(lane.sigma_m)], axis=-1)
    confidence = np.stack([x, Scale(0.0, 1.0, panel.bottom, panel.top + 6).px(lane.confidence)], axis=-1)
    right = panel.right + 6
    return [
        panel.frame(),
        *polylines(confidence, _CONFIDENCE, 2.0),
        *polylines(sigma, _CENTRE, 1.4),
        panel.label_left(panel.top + 10, f"{100 * full_m:g} cm"),
        panel.label_left(panel.bottom, "0"),
        panel.label_left(panel.middle + 4, "sigma", colour=_CENTRE, bold=True),
        text(right, panel.top + 12, "1", colour=GREY),
        text(right, panel.bottom, "0", colour=GREY),
        text(right, panel.middle - 3, "confi-", colour=_CONFIDENCE_LABEL, bold=True),
        text(right, panel.middle + 10, "dence", colour=_CONFIDENCE_LABEL, bold=True),
    ]


def _station_axis(lane: LanePicture, strip: Panel, sigma: Panel) -> list[str]:
    """Ticks under the lower panel and between the two."""
    along = _along(lane)
    parts = []
    for station_m in ticks(along.first, along.last, nice_step((along.last - along.first) / 8)):
        x = along.at(station_m)
        parts.append(stroke(f"M{x:.1f} {strip.bottom}V{sigma.top}", _TICK))
        parts += sigma.tick_below(x, f"{station_m:g} m", _TICK)
    return parts

"""A picture of a decoded lane, as SVG: from above, straightened, how sure it is, and the radio's strength."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from app.decoders.cerpm.lane_frame import plane_from_wgs84
from app.decoders.cerpm.lane_types import Lane, LaneMarkers
from app.jobs.plot_strokes import LEFT, RIGHT, WIDTH, area, dots, frame, label, nice_step, outlined, polylines, thin
from app.jobs.signal_plot import PANEL_HEIGHT, SignalPicture, signal_panel
from app.sensors.pose_track import PoseTrack

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_LONG_M = 3000.0
_PLAN_TOP, _PLAN_LEAST, _PLAN_MOST = 66, 130, 380
_STRIP, _SURE = 150, 86  # heights of the panels below the plan
_LEAST_M, _MARGIN_PX = (30.0, 6.0), 26
_MOST_LABELS, _MOST_TITLES = 14, 400
_SIDE_COLOURS = {0: "#7d3c98", 1: "#1f5fa8", 2: "#d68910"}
_CENTRE, _TRACK, _OUT, _CONFIDENCE = "#2d3e50", "#1e8449", "#c0392b", "#8fb7b2"


@dataclass(frozen=True, slots=True, eq=False)
class LanePicture:
    """What a picture of a lane shows; east and north of one origin throughout.

    Attributes
    ----------
    centre_m, left_m, right_m : ndarray, shape (S, 2)
        Centre line and boundaries, NaN where they are not known; empty where the lane was refused. [m]
    station_m, sigma_m, confidence : ndarray, shape (S,)
    marker_m : ndarray, shape (K, 2)
        NaN where a marker has no place. [m]
    marker_number, marker_side : ndarray of int, shape (K,)
        Sides as in `LaneSide`: 0 unknown, 1 left, 2 right.
    left_out : dict of int to str
        Why markers were left out, by their row.
    track_m : ndarray, shape (T, 2)
        Where the vehicle drove; may be empty. [m]
    refusal : str or None
        Why there is no lane.
    """

    centre_m: Floats
    left_m: Floats
    right_m: Floats
    station_m: Floats
    sigma_m: Floats
    confidence: Floats
    marker_m: Floats
    marker_number: Ints
    marker_side: Ints
    left_out: dict[int, str] = field(default_factory=dict)
    track_m: Floats = field(default_factory=lambda: np.empty((0, 2)))
    refusal: str | None = None


def picture_of_lane(lane: Lane, markers: LaneMarkers, track: PoseTrack | None = None) -> LanePicture:
    """What to show of a lane and the markers that it was decoded from, in the lane's own plane."""
    origin = (lane.origin_lon_deg, lane.origin_lat_deg)
    earthly = (np.abs(markers.lat_deg) <= 90) & (np.abs(markers.lon_deg) <= 360)
    marker_m = np.full((len(markers), 2), np.nan)
    marker_m[earthly] = plane_from_wgs84(markers.lon_deg[earthly], markers.lat_deg[earthly], origin)
    return LanePicture(
        lane.position_enu_m,
        lane.left_enu_m,
        lane.right_enu_m,
        lane.station_m,
        lane.sigma_m,
        lane.confidence,
        marker_m,
        markers.number,
        np.where(lane.side > 0, lane.side, markers.side),
        {out.row: out.reason.value.replace("_", " ") for out in lane.left_out},
        np.empty((0, 2)) if track is None else plane_from_wgs84(track.lon_deg, track.lat_deg, origin),
        lane.refusal,
    )


def plot_lane(lane: LanePicture, signals: SignalPicture | None = None) -> str:
    """SVG of a lane.

    From top to bottom: the lane from above at one scale, turned so that it lies along the page; the same straightened,
    metres to the left and right of its centre line, so that markers and the track can be seen beside it on long lanes;
    its standard deviation and confidence along the way; RSSI over distance with the fitted line and the paper's two
    points. Markers are blue left, orange right and violet without a side; those left out are crossed out in red, with
    number and reason.
    """
    view = _plan_view(lane)
    panels, below = [], _PLAN_TOP
    if view is not None:
        panels += _plan_panel(lane, view)
        below += view.height + 34
    if len(lane.centre_m) > 1:
        panels += _strip_panel(lane, below)
        panels += _sure_panel(lane, below + _STRIP + 14)
        panels += _station_axis(lane, below, below + _STRIP + 14 + _SURE)
        below += _STRIP + _SURE + 64
    if signals is not None:
        below += 0 if len(lane.centre_m) > 1 else 26
        panels += signal_panel(signals, below)
        below += PANEL_HEIGHT + 44
    head = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {below}" width="{WIDTH}" height="{below}" '
        'font-family="sans-serif" font-size="12">',
        f'<rect width="{WIDTH}" height="{below}" fill="white"/>',
        f'<text x="{LEFT}" y="20" font-size="15" font-weight="bold">{escape(_title(lane))}</text>',
        _legend(),
        _placeless(lane),
    ]
    return "\n".join([*head, *panels, "</svg>\n"])


def _title(lane: LanePicture) -> str:
    out = len(lane.left_out)
    used = len(lane.marker_m) - out
    markers = f"{used} marker{'s' * (used != 1)}" + (f", {out} left out" if out else "")
    if len(lane.centre_m) < 2:
        return f"No lane: {lane.refusal or 'no path'}; {markers}"
    length = _length_text(float(lane.station_m[-1] - lane.station_m[0]))
    known = lane.sigma_m[np.isfinite(lane.sigma_m)]
    sure = f"; ± {100 * np.median(known):.1f} cm, at worst ± {100 * known.max():.0f} cm" if len(known) else ""
    return f"Lane of {length}: {markers}{sure}"


def _length_text(length_m: float) -> str:
    return f"{length_m / 1000:.2f} km" if length_m >= 10_000 else f"{length_m:.0f} m"


def _legend() -> str:
    parts = [
        f'<tspan fill="{_SIDE_COLOURS[1]}">● left</tspan>', f'<tspan fill="{_SIDE_COLOURS[2]}">● right</tspan>',
        f'<tspan fill="{_SIDE_COLOURS[0]}">● no side</tspan>', f'<tspan fill="{_OUT}">✕ left out</tspan>',
        f'<tspan fill="{_CENTRE}" font-weight="bold">— centre line</tspan>',
        f'<tspan fill="{_TRACK}">‒ ‒ vehicle</tspan>',
    ]  # fmt: skip
    return f'<text x="{LEFT}" y="42" xml:space="preserve">{"     ".join(parts)}</text>'


def _placeless(lane: LanePicture) -> str:
    """Markers that were left out and have no place to be drawn at."""
    rows = [row for row in sorted(lane.left_out) if not np.isfinite(lane.marker_m[row]).all()]
    if not rows:
        return ""
    named = ", ".join(f"{int(lane.marker_number[row])}: {lane.left_out[row]}" for row in rows[:3])
    more = f" and {len(rows) - 3} more" if len(rows) > 3 else ""
    return f'<text x="{RIGHT}" y="42" text-anchor="end" fill="{_OUT}" font-size="11">{escape(named)}{more}</text>'


# --- from above ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _PlanView:
    turn: Floats
    origin: Floats
    scale: float
    height: int

    def px(self, points_m: Floats) -> Floats:
        x, y = ((points_m - self.origin) @ self.turn.T * self.scale).T
        return np.stack([LEFT + _MARGIN_PX + x, _PLAN_TOP + self.height - _MARGIN_PX - y], axis=-1)


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
        lines.append(markers[cKDTree(shape).query(markers)[0] < reach])
    turned = np.vstack(lines) @ turn.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    extent = np.maximum(high - low, _LEAST_M)
    room = np.array([RIGHT - LEFT, _PLAN_MOST]) - 2 * _MARGIN_PX
    scale = float((room / extent).min())
    height = int(max(extent[1] * scale + 2 * _MARGIN_PX, _PLAN_LEAST))
    spare = np.array([room[0], height - 2 * _MARGIN_PX]) / scale - (high - low)
    return _PlanView(turn, (low - spare / 2) @ turn, scale, height)


def _plan_panel(lane: LanePicture, view: _PlanView) -> list[str]:
    box = (LEFT, _PLAN_TOP, RIGHT, _PLAN_TOP + view.height)
    parts = [
        f'<clipPath id="plan"><rect x="{box[0]}" y="{box[1]}" width="{box[2] - box[0]}" height="{view.height}"/>'
        "</clipPath>",
        frame(_PLAN_TOP, view.height),
        '<g clip-path="url(#plan)">',
    ]
    left, right, centre = (view.px(line) for line in (lane.left_m, lane.right_m, lane.centre_m))
    parts += area(left, right)
    for line, colour, width, dash in (
        (left, _SIDE_COLOURS[1], 1.2, ""), (right, _SIDE_COLOURS[2], 1.2, ""),
        (view.px(lane.track_m), _TRACK, 1.2, "6 4"), (centre, _CENTRE, 1.5, ""),
    ):  # fmt: skip
        parts += polylines(line, colour, width, dash)
    parts.append("</g>")
    parts += _markers(lane, view.px(lane.marker_m), box, 3.2)
    return [*parts, *_scale_and_north(view)]


def _scale_and_north(view: _PlanView) -> list[str]:
    length = nice_step(120 / view.scale)
    y = _PLAN_TOP + view.height + 16
    north = view.turn @ (0.0, 1.0)
    x0, y0 = RIGHT - 14, y - 4
    dx, dy = 11 * north[0], -11 * north[1]
    return [
        f'<path d="M{LEFT} {y - 8}v5h{length * view.scale:.1f}v-5" fill="none" stroke="#555"/>',
        f'<text x="{LEFT + length * view.scale + 6:.1f}" y="{y}" fill="#555">{_length_text(length)}</text>',
        f'<path d="M{x0 - dx:.1f} {y0 - dy:.1f}L{x0 + dx:.1f} {y0 + dy:.1f}" stroke="#555" stroke-width="1.5"/>',
        f'<path d="M{x0 + dx:.1f} {y0 + dy:.1f}l{-0.6 * dx - 0.35 * dy:.1f} {-0.6 * dy + 0.35 * dx:.1f}'
        f'l{0.7 * dy:.1f} {-0.7 * dx:.1f}z" fill="#555"/>',
        f'<text x="{x0 - 18}" y="{y}" text-anchor="end" fill="#555">north</text>',
    ]


def _markers(lane: LanePicture, at_px: Floats, box: tuple[int, int, int, int], size: float) -> list[str]:
    """Dots by side; crosses and labels for what was left out, drawn last and at the border where it lies beyond."""
    crosses: list[str] = []
    taken: list[_Box] = []
    inside: npt.NDArray[np.bool_] = np.all((at_px >= box[:2]) & (at_px <= box[2:]), axis=1)
    inside[list(lane.left_out)] = False
    sides = [_SIDE_COLOURS.get(side, _SIDE_COLOURS[0]) for side in lane.marker_side.tolist()]
    if len(at_px) > _MOST_TITLES:
        wanted = {colour: inside & (np.array(sides) == colour) for colour in _SIDE_COLOURS.values()}
        parts = [dots(at_px[rows], colour, size) for colour, rows in wanted.items()]
    else:
        parts = [
            f'<circle cx="{at_px[row, 0]:.1f}" cy="{at_px[row, 1]:.1f}" r="{size}" fill="{sides[row]}">'
            f"<title>marker {int(lane.marker_number[row])}</title></circle>"
            for row in np.flatnonzero(inside).tolist()
        ]
    for row, reason in sorted(lane.left_out.items()):
        x, y = at_px[row].tolist()
        if not math.isfinite(x + y):
            continue
        beyond = not (box[0] <= x <= box[2] and box[1] <= y <= box[3])
        x, y = min(max(x, box[0] + 6), box[2] - 6), min(max(y, box[1] + 6), box[3] - 6)
        text = f"{int(lane.marker_number[row])}: {reason}" + (" (beyond)" if beyond else "")
        crosses.append(
            f'<path d="M{x - 4:.1f} {y - 4:.1f}l8 8m0 -8l-8 8" stroke="{_OUT}" stroke-width="2">'
            f"<title>marker {escape(text)}</title></path>"
        )
        spot = _free_spot(x, y, 6.4 * len(text), box, taken) if len(taken) < _MOST_LABELS else None
        if spot is not None:
            taken.append(spot)
            side, anchor = (spot[0], "start") if spot[0] > x else (spot[2], "end")
            crosses.append(outlined(side, spot[3] - 3, escape(text), _OUT, anchor))
    return parts + crosses


_Box = tuple[float, float, float, float]


def _free_spot(x: float, y: float, width: float, box: tuple[int, int, int, int], taken: Sequence[_Box]) -> _Box | None:
    """Room for a label beside a cross: right, left, above or below."""
    for step in (0, 14, -14, 28, -28):
        for x0 in (x + 7, x - 7 - width):
            spot = (x0, y - 7 + step, x0 + width, y + 7 + step)
            inside = spot[0] >= box[0] and spot[1] >= box[1] and spot[2] <= box[2] and spot[3] <= box[3]
            clear = all(spot[0] > t[2] or spot[2] < t[0] or spot[1] > t[3] or spot[3] < t[1] for t in taken)
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
    nearest = cKDTree(lane.centre_m).query(points_m[rows])[1]
    ahead = np.gradient(lane.centre_m, axis=0)[nearest]
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-12)[:, None]
    offset = points_m[rows] - lane.centre_m[nearest]
    along = np.sum(offset * ahead, axis=1)
    left = ahead[:, 0] * offset[:, 1] - ahead[:, 1] * offset[:, 0]
    ends = (nearest == 0) | (nearest == len(lane.centre_m) - 1)
    kept = ~(ends & (np.abs(along) > 5.0)) | (np.abs(left) > np.abs(along))
    out[rows[kept]] = np.column_stack([lane.station_m[nearest] + along, left])[kept]
    return out


def _station_px(lane: LanePicture, station_m: Floats) -> Floats:
    first, last = float(lane.station_m[0]), float(lane.station_m[-1])
    return np.clip(LEFT + (RIGHT - LEFT) * (station_m - first) / max(last - first, 1e-9), LEFT, RIGHT)


def _strip_panel(lane: LanePicture, top: int) -> list[str]:
    sides = []
    for line in (lane.left_m, lane.right_m):
        ahead = np.gradient(lane.centre_m, axis=0)
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-12)[:, None]
        offset = line - lane.centre_m
        sides.append(ahead[:, 0] * offset[:, 1] - ahead[:, 1] * offset[:, 0])
    known = np.abs(np.concatenate(sides))
    half = float(np.clip(np.nanmax(known, initial=1.8) + 1.0, 2.5, 8.0))
    middle = top + _STRIP / 2

    def px(station_m: Floats, left_m: Floats) -> Floats:
        return np.stack([_station_px(lane, station_m), middle - _STRIP / 2 * left_m / half], axis=-1)

    left, right = (px(lane.station_m, side) for side in sides)
    dash = "6 4" if lane.station_m[-1] - lane.station_m[0] < _LONG_M else ""  # dashes of a zigzag say nothing
    parts = [
        f'<clipPath id="strip"><rect x="{LEFT}" y="{top}" width="{RIGHT - LEFT}" height="{_STRIP}"/></clipPath>',
        frame(top, _STRIP), '<g clip-path="url(#strip)">', *area(left, right),
        *polylines(left, _SIDE_COLOURS[1], 1.2), *polylines(right, _SIDE_COLOURS[2], 1.2),
        *polylines(px(*_beside(lane, thin(lane.track_m)).T), _TRACK, 1.2, dash),
        f'<path d="M{LEFT} {middle}H{RIGHT}" stroke="{_CENTRE}" stroke-width="1.5"/>', "</g>",
    ]  # fmt: skip
    step = 1 if half < 4 else 2
    for tick in range(-int(half), int(half) + 1):
        if tick % step == 0:
            y = middle - _STRIP / 2 * tick / half
            text = f"{abs(tick)} m" + (" left" if tick == step else " right" if tick == -step else "")
            parts.append(label(LEFT - 6, y + 4, text))
    at = _beside(lane, lane.marker_m)
    parts += _markers(lane, px(at[:, 0], at[:, 1]), (LEFT, top, RIGHT, top + _STRIP), 2.6)
    return parts


def _sure_panel(lane: LanePicture, top: int) -> list[str]:
    bottom = top + _SURE
    known = lane.sigma_m[np.isfinite(lane.sigma_m)]
    full = nice_step(1.2 * float(known.max()) if len(known) else 0.1, up=True)
    x = _station_px(lane, lane.station_m)
    sigma = np.stack([x, bottom - _SURE * np.clip(lane.sigma_m / full, 0, 1)], axis=-1)
    confidence = np.stack([x, bottom - (_SURE - 6) * np.clip(lane.confidence, 0, 1)], axis=-1)
    return [
        frame(top, _SURE),
        *polylines(confidence, _CONFIDENCE, 2.0),
        *polylines(sigma, _CENTRE, 1.4),
        label(LEFT - 6, top + 10, f"{100 * full:g} cm"),
        label(LEFT - 6, bottom, "0"),
        f'<text x="{LEFT - 6}" y="{(top + bottom) / 2 + 4}" text-anchor="end" fill="{_CENTRE}" font-weight="bold">'
        "sigma</text>",
        f'<text x="{RIGHT + 6}" y="{top + 12}" fill="#555">1</text>',
        f'<text x="{RIGHT + 6}" y="{bottom}" fill="#555">0</text>',
        f'<text x="{RIGHT + 6}" y="{(top + bottom) / 2 - 3}" fill="#4e8a83" font-weight="bold">confi-'
        f'<tspan x="{RIGHT + 6}" dy="13">dence</tspan></text>',
    ]


def _station_axis(lane: LanePicture, top: int, bottom: int) -> list[str]:
    first, last = float(lane.station_m[0]), float(lane.station_m[-1])
    step = nice_step((last - first) / 8)
    parts = []
    for k in range(math.ceil(first / step), math.floor(last / step) + 1):
        x = float(_station_px(lane, np.array(k * step)))
        parts.append(f'<path d="M{x:.1f} {bottom}v5M{x:.1f} {top + _STRIP}v14" stroke="#aaa"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 19}" text-anchor="middle">{k * step:g} m</text>')
    return parts

"""Lanes whose centre is known exactly, for the tests of the fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pymap3d

from app.lanes.estimate import Lane, LaneMarkers
from app.sensors.pose_track import PoseTrack

LON, LAT = 8.4, 49.0


def on_globe(points_m, lon=LON, lat=LAT):
    lat_deg, lon_deg, _ = pymap3d.enu2geodetic(points_m[:, 0], points_m[:, 1], 0.0, lat, lon, 0.0)
    return (np.asarray(lon_deg) + 180) % 360 - 180, np.asarray(lat_deg)


def in_plane(lon_deg, lat_deg, lon=LON, lat=LAT):
    east, north, _ = pymap3d.geodetic2enu(lat_deg, lon_deg, 0.0, lat, lon, 0.0)
    return np.stack([east, north], 1)


@dataclass
class Road:
    """A centre line by its curvature, every quarter metre."""

    curvature: np.ndarray
    width: np.ndarray

    def __post_init__(self):
        yaw = np.concatenate([[0.3], 0.3 + np.cumsum((self.curvature[1:] + self.curvature[:-1]) / 8)])
        mid = (yaw[1:] + yaw[:-1]) / 2
        self.centre = np.concatenate([[[0, 0]], np.cumsum(np.stack([np.cos(mid), np.sin(mid)], 1) / 4, axis=0)])
        self.normal = np.stack([-np.sin(yaw), np.cos(yaw)], 1)
        self.yaw = yaw
        self.at = np.arange(len(yaw)) / 4

    def beside(self, station, left):
        base, normal = (
            np.stack([np.interp(station, self.at, values[:, k]) for k in range(2)], 1)
            for values in (self.centre, self.normal)
        )
        return base + normal * np.broadcast_to(left, np.shape(station))[:, None]

    def errors(self, lane: Lane, *, lon=LON, lat=LAT, ends=2.0):
        """Left offset of the path's stations from the centre, those past its ends left out."""
        points = in_plane(lane.lon_deg, lane.lat_deg, lon, lat)
        off = points[:, None] - self.centre[None]
        nearest = np.argmin(np.hypot(off[..., 0], off[..., 1]), axis=1)
        inside = (self.at[nearest] > ends) & (self.at[nearest] < self.at[-1] - ends)
        return np.sum(off[np.arange(len(points)), nearest] * self.normal[nearest], 1)[inside]


def bendy(length=300.0):
    """Straight, a left bend of radius 60 m, straight, a right one of 30 m."""
    at = np.arange(0, length + 0.1, 0.25)
    knots = [0, 60, 80, 110, 130, 170, 190, 220, 240, length]
    return Road(np.interp(at, knots, [0, 0, 1 / 60, 1 / 60, 0, 0, -1 / 30, -1 / 30, 0, 0]), np.full(len(at), 3.2))


def straight(length=200.0):
    at = np.arange(0, length + 0.1, 0.25)
    return Road(np.zeros(len(at)), np.full(len(at), 3.2))


def place(road, rng, *, spacing=12.192, labelled=True, noise=0.02, lon=LON, lat=LAT, limit=40.0):
    """Markers on both boundaries, in no order."""
    at = np.linspace(0, road.at[-1], round(road.at[-1] / spacing) + 1)
    points = np.concatenate([road.beside(at, 1.6), road.beside(at, -1.6)]) + rng.normal(0, noise, (2 * len(at), 2))
    side = np.repeat([1, 2], len(at))
    return markers_at(
        points, side if labelled else 0 * side, rng.permutation(2 * len(at)), lon=lon, lat=lat, limit=limit
    )


def markers_at(points, side, order=None, *, number=None, lon=LON, lat=LAT, limit=np.nan, sigma=0.02):
    points = np.asarray(points, float).reshape(-1, 2)
    order = np.arange(len(points)) if order is None else order
    lon_deg, lat_deg = on_globe(points, lon, lat)
    number = np.arange(len(points)) + 1 if number is None else np.asarray(number)
    side = np.broadcast_to(side, len(points)).astype(np.int64)
    return LaneMarkers(
        number[order],
        lon_deg[order],
        lat_deg[order],
        side[order],
        np.full(len(points), sigma),
        np.full(len(points), limit),
    )


def chosen(markers, which):
    return LaneMarkers(*(getattr(markers, name)[which] for name in LaneMarkers.__slots__))


def moved(markers, k, by_m, lon=LON, lat=LAT):
    """The same with one marker claiming another place."""
    points = in_plane(markers.lon_deg, markers.lat_deg, lon, lat)
    points[k] += by_m
    lon_deg, lat_deg = on_globe(points, lon, lat)
    return LaneMarkers(markers.number, lon_deg, lat_deg, markers.side, markers.sigma_m, markers.speed_limit_kmh)


def drive(road, rng, *, wander=0.18, length=30.0, noise=0.02, offset=0.0, lon=LON, lat=LAT, accuracy=0.02):
    """A track that wanders about the centre."""
    at = np.arange(0, road.at[-1], 0.8)
    wave = rng.normal(0, 1, 8), rng.uniform(1 / (8 * length), 1 / (2 * length), 8), rng.uniform(0, 2 * np.pi, 8)
    left = wander / 2 * np.sum(wave[0] * np.sin(2 * np.pi * at[:, None] * wave[1] + wave[2]), axis=1)
    points = road.beside(at, left) + rng.normal(0, noise, (len(at), 2)) + offset
    lon_deg, lat_deg = on_globe(points, lon, lat)
    return PoseTrack(
        1.7e9 + 0.07 * np.arange(len(at)), lon_deg, lat_deg, np.full(len(at), np.nan), np.full(len(at), accuracy)
    )

"""Scenes: networks of markers, vehicles with errors of their own, and faults that begin while vehicles drive.

The simulation draws from other distributions than the tests assume: position errors of Student's t, biases of each
vehicle and each drive, fog over stretches, dirt that comes and goes, trucks, other lanes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Rng = np.random.Generator
FAMILIES = ("plate", "magnet", "cerpm")
DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Scene:
    """What is simulated."""

    name: str
    # `roads`, `markers`: roads, and markers of each
    roads: int = 10
    markers: int = 40
    # `vehicles`, `drives`: a drive follows one road; the drives are spread over 30 days
    vehicles: int = 100
    drives: int = 1000
    families: tuple[float, float, float] = (0.6, 0.25, 0.15)  # shares of `FAMILIES`
    bias_m: float = 0.3  # [m] standard deviation of a vehicle's own shift, each axis
    miscalibrated: float = 0.05  # share of vehicles with a shift of 1 to 2.5 m
    # [m] of a plate's position relative to the vehicle, each axis; Student's t with 3 degrees of freedom
    noise_m: float = 0.08
    dirty: float = 0.05  # share of plates that are read 30 to 70 % as often as clean ones
    fog: float = 0.05  # share of drives in fog, half of them over the whole road
    other_lane: float = 0.15  # share of drives on a lane from which markers are half as visible
    wrong_way_drives: int = 3


SCENES = (
    Scene("mixed traffic"),
    Scene("plates only", families=(1.0, 0.0, 0.0)),
    Scene("magnets only", families=(0.0, 1.0, 0.0)),
    Scene("CERPMs only", families=(0.0, 0.0, 1.0)),
    Scene("few vehicles", vehicles=8),
    Scene("busy road", roads=2, vehicles=400),
    Scene("dirty winter", dirty=0.3, fog=0.2),
    Scene("badly calibrated fleet", bias_m=0.6, miscalibrated=0.2),
    Scene("inaccurate positions", noise_m=0.14),
    Scene("sparse markers", markers=8, roads=12),
)


@dataclass(slots=True)
class Markers:
    """Truth about the markers of a network, arrays of shape (roads, markers)."""

    family: np.ndarray  # index in `FAMILIES`
    expected: np.ndarray  # reading probability of a clean one by the tables
    dirt: np.ndarray  # factor on it
    survey_m: np.ndarray  # shape (roads, markers, 2): [m] error of the registered position
    fault: np.ndarray  # empty where healthy
    since_s: np.ndarray  # [s] when the fault begins
    offset_m: np.ndarray  # shape (roads, markers, 2): [m] of those that move


SURVEY_SIGMA_M = 0.05
_EXPECTED = {"plate": (0.85, 0.98), "magnet": (0.92, 0.98), "cerpm": (0.85, 0.97)}


def draw_markers(scene: Scene, rng: Rng, fault_share: float) -> Markers:
    """Markers with faults: each kind on about the same number of markers, and at least one of each."""
    shape = (scene.roads, scene.markers)
    family = rng.choice(3, size=shape, p=scene.families)
    low, high = np.array([_EXPECTED[name] for name in FAMILIES]).T
    expected = rng.uniform(low[family], high[family])
    dirt = np.where((family == 0) & (rng.random(shape) < scene.dirty), rng.uniform(0.3, 0.7, shape), 1.0)
    fault = np.full(shape, "", dtype=object)
    kinds = ("moved", "moved", "missing", "cloned", "wrong-way", "fading")
    spots = rng.permutation(shape[0] * shape[1])
    # faults are apart: of two neighbours that both have moved, the third is the odd one out
    chosen: list[int] = []
    for spot in spots.tolist():
        road, place = divmod(spot, scene.markers)
        near = any(road == other // scene.markers and abs(place - other % scene.markers) < 3 for other in chosen)
        if len(chosen) < max(len(kinds), round(fault_share * shape[0] * shape[1])) and not near:
            chosen.append(spot)
    for k, spot in enumerate(chosen):
        fault[divmod(spot, scene.markers)] = kinds[k % len(kinds)]
    fault[(fault == "wrong-way") & (family == 2)] = "missing"  # a radio has no direction
    since_s = rng.uniform(0.1, 0.5, shape) * 30 * DAY_S
    distance_m, angle = rng.uniform(1.0, 4.0, shape), rng.uniform(0, 2 * np.pi, shape)
    # a tag that is moved across the lane leaves the bar: it is missed; along the lane it is read elsewhere
    angle = np.where(family == 1, rng.choice([0.0, np.pi], size=shape), angle)
    offset_m = distance_m[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    survey_m = rng.normal(0.0, SURVEY_SIGMA_M, (*shape, 2))
    return Markers(family, expected, dirt, survey_m, fault, since_s, offset_m)


@dataclass(slots=True)
class Vehicles:
    """Truth about vehicles, arrays of shape (vehicles,)."""

    shift_m: np.ndarray  # shape (vehicles, 2) [m]
    miss: np.ndarray  # share of markers that it misses, 2 to 30 %


def draw_vehicles(scene: Scene, rng: Rng) -> Vehicles:
    """Vehicles with a shift and a miss rate of their own."""
    shift = rng.normal(0.0, scene.bias_m, (scene.vehicles, 2))
    wrong = rng.random(scene.vehicles) < scene.miscalibrated
    angle, far = rng.uniform(0, 2 * np.pi, scene.vehicles), rng.uniform(1.0, 2.5, scene.vehicles)
    shift[wrong] += (far[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))[wrong]
    return Vehicles(shift, rng.uniform(0.02, 0.30, scene.vehicles))

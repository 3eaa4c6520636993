"""Rows about roads with several marked lanes: the path of the driven one, by topology and receiver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from app.decoders.cerpm.merge import merge_markers
from app.decoders.cerpm.verify import verify_packets
from app.decoding.recordings import packet_strengths
from app.lanes.estimate import Lane, fit_lane
from app.services.decodes.packet_documents import path_warnings
from app.simulation.radio.drive import SatelliteReceiver, drive_past
from app.values import Ints
from benchmarks.cerpm import scenes
from benchmarks.cerpm.path_errors import place_errors
from benchmarks.cerpm.paths import Result
from benchmarks.cerpm.topologies import TOPOLOGIES, Topology, make_topology

RECEIVERS = {"2 cm": SatelliteReceiver.rtk, "2 m": SatelliteReceiver.plain}
GOALS_M = {"2 cm": 0.03, "2 m": 0.10}  # RMS of a path; with 2 m, or a refusal
REGISTERED = {"no": None, "yes": 0.0, "5 % wrong": 0.05}
"""Share of the markers that are registered on another line of the road; None where no lines are registered."""
END_M = 30.0  # [m] of a lane at each end, where the vehicle has not yet passed markers on both sides


class DrivenPath(NamedTuple):
    """What a drive gave."""

    refusal: str | None
    rms_m: float  # [m] distance from the true centre line; infinite where the path is not beside it
    fit: bool  # the service would call it fit to localize a vehicle


def run_lanes(seed: int, short: bool) -> Result:
    """Topology by topology, drive by drive."""
    rows: list[Sequence[object]] = []
    for number, name in enumerate(TOPOLOGIES):
        for receiver in RECEIVERS:
            drives = [drive_topology(name, receiver, (seed, 60, number, run)) for run in range(2 if short else 10)]
            for registered in REGISTERED:
                driven = [drive[registered] for drive in drives]
                paths = [one for one in driven if one.refusal is None]
                goal_m = GOALS_M[receiver]
                wrong = sum(one.rms_m > goal_m for one in paths)
                silent = sum(one.rms_m > goal_m and one.fit for one in paths)
                worst = f"{max(one.rms_m for one in paths):.3f}" if paths else "–"
                counts = (len(driven), len(paths) - wrong, len(driven) - len(paths), wrong, silent)
                rows.append((name, receiver, registered, *counts, worst))
    note = (
        "Drives of 500 m past the markers of all lanes of a road. A path is right if its RMS distance from the true "
        f"centre line of the driven lane is within {GOALS_M['2 cm']:g} m with a receiver of 2 cm, and within "
        f"{GOALS_M['2 m']:g} m with one of 2 m, {END_M:g} m at both ends left out; after a change of lane, the driven "
        "lane is the last one. Wrong paths that are called fit to localize a vehicle are silent errors. The same "
        "drives are decoded without registered lines, with the line of each marker registered as the commit of a plan "
        "does, and with 5 % of the markers registered on another line of the road."
    )
    head = ("road", "receiver", "lines registered", "drives", "right", "refused", "wrong", "silent", "worst RMS [m]")
    return note, head, rows


def drive_topology(name: str, receiver: str, seed: Sequence[int]) -> dict[str, DrivenPath]:
    """Drive a road of a topology, and decode the log as an upload is decoded; by which lines are registered."""
    rng = np.random.default_rng(seed)
    road = make_topology(name, rng)
    heard = drive_past(road.course, road.installed, rng, sign=scenes.sign, receiver=RECEIVERS[receiver]())
    verification = verify_packets(heard.packets, scenes.keys_for(road.installed))
    markers = scenes.markers_from_merged(merge_markers(verification.packets, {}, heard.track))
    strengths = packet_strengths(verification)
    paths = {}
    for registered, wrong in REGISTERED.items():
        known = markers if wrong is None else replace(markers, line=_registered_lines(road, markers.number, wrong, rng))
        paths[registered] = _judged(fit_lane(known, heard.track, strengths=strengths), road)
    return paths


def _registered_lines(road: Topology, number: Ints, wrong_share: float, rng: np.random.Generator) -> Ints:
    """The line that each marker is registered on, shape (K,)."""
    lines = np.unique(road.line)
    line = np.where(rng.random(len(road.line)) < wrong_share, rng.choice(lines, len(road.line)), road.line)
    order = np.argsort(road.installed.number)
    return np.asarray(line[order][np.searchsorted(road.installed.number[order], number)])


def _judged(lane: Lane, road: Topology) -> DrivenPath:
    if lane.refusal is not None:
        return DrivenPath(lane.refusal, np.inf, fit=False)
    errors = place_errors(road.lane, lane, END_M, road.lane.length_m - END_M)
    fit = not path_warnings(lane) and not lane.track_apart
    return DrivenPath(None, np.inf if errors is None else errors.rms_m, fit)

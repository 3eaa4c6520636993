"""The rows of ``python -m benchmarks.cerpm physics``: paths and path loss from drives with a second physics.

Every row has the same drives but for one option of the simulation (the last: all of them).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from app.decoders.cerpm.merge import merge_markers
from app.decoders.cerpm.verify import verify_packets
from app.lanes.estimate import fit_lane
from app.radio.link import fit_path_loss
from app.simulation.radio.drive import Multipath, SatelliteReceiver, drive_past
from app.simulation.radio.lanes import TrueLane
from app.simulation.radio.link import ANTENNA_M, AntennaPattern, Radio, TwoRay, mean_rssi_dbm
from app.values import Floats
from benchmarks.cerpm import scenes
from benchmarks.cerpm.path_errors import Tally, path_errors, track_errors
from benchmarks.cerpm.paths import Result, list_scenes, span_of

COMPARED_M = np.geomspace(5.0, 100.0, 50)
"""Distances at which a fitted path loss is compared. [m] Source: by hand; packets come from up to about 100 m."""


@dataclass(frozen=True, slots=True)
class Physics:
    """What differs from the usual simulation."""

    name: str
    radio: Radio = field(default_factory=Radio)
    multipath: Multipath | None = None


ROWS = (
    Physics("base: log-distance, no multipath"),
    Physics("two-ray ground reflection", Radio(two_ray=TwoRay())),
    Physics("antenna weak behind and beside", Radio(antenna_pattern=AntennaPattern())),
    Physics("multipath of the satellite receiver", multipath=Multipath()),
    Physics("all together", Radio(two_ray=TwoRay(), antenna_pattern=AntennaPattern()), Multipath()),
)


@dataclass
class Row:
    """Sums over the drives of a row."""

    path: Tally = field(default_factory=Tally)
    own: Tally = field(default_factory=Tally)
    installed: int = 0
    received: int = 0
    packets: int = 0
    left_out: int = 0
    exponents: list[float] = field(default_factory=list)
    line_errors_db: list[Floats] = field(default_factory=list)


def run_physics(seed: int, short: bool) -> Result:
    """One row for each option: paths at 40 ft from received packets, and the fitted path loss."""
    rows: list[Sequence[object]] = []
    for physics in ROWS:
        row = Row()
        for _name, lane, rng in list_scenes(seed, short, 80):
            add_drive(row, physics, lane, rng)
        error_db = np.concatenate(row.line_errors_db)
        rows.append(
            (
                physics.name, f"{row.received} of {row.installed}", row.packets, f"{row.path.rms_m:.3f}",
                f"{row.path.worst_m:.2f}", f"{100 * row.path.share_within_two_sigma:.1f} %", row.path.refused,
                row.left_out, f"{row.own.rms_m:.3f}", f"{np.mean(row.exponents):.2f}",
                f"{np.sqrt(np.mean(error_db**2)):.1f}",
            )
        )  # fmt: skip
    head = (
        "simulation", "markers received", "packets", "RMS [m]", "max [m]", "within 2 sigma", "refused",
        "markers left out", "own track", "exponent", "path loss [dB]",
    )  # fmt: skip
    note = (
        "Drives with RTK past markers every 40 ft, through link, verifier and merger. RMS and maximum of the distance "
        "from the true centre line to the path; share of places whose error is within two of the path's standard "
        "deviations (95.4 % if those are right). Own track: RMS of the vehicle's positions used as path. Exponent: "
        "mean of the fitted path losses; path loss: RMS of the fitted line against the true mean strength in front of "
        "the vehicle, 5 to 100 m."
    )
    return note, head, rows


def add_drive(row: Row, physics: Physics, lane: TrueLane, rng: np.random.Generator) -> None:
    """Drive a lane, and add the path and the path loss from what was received."""
    installed = scenes.install(lane, rng)
    receiver = replace(SatelliteReceiver.rtk(), multipath=physics.multipath)
    drive = drive_past(lane, installed, rng, sign=scenes.sign, radio=physics.radio, receiver=receiver)
    heard = np.unique(drive.sender)
    row.installed, row.received = row.installed + len(installed), row.received + len(heard)
    row.packets += len(drive.packets)
    verified = verify_packets(drive.packets, scenes.keys_for(installed)).packets
    path = fit_lane(scenes.markers_from_merged(merge_markers(verified, {}, drive.track)), drive.track)
    first, last = span_of(installed.chosen(heard))
    row.left_out += len(path.left_out)
    row.path.add(path_errors(lane, path, first, last))
    row.own.add(track_errors(lane, drive.track, first, last))
    rssi_dbm = [packet.rssi_dbm for packet in drive.packets]
    line = fit_path_loss(drive.distance_m[drive.transmission], rssi_dbm, drive.sender)
    if line is not None:
        row.exponents.append(line.exponent.value)
        row.line_errors_db.append(line.rssi_dbm(COMPARED_M) - _true_mean_dbm(physics.radio))


def _true_mean_dbm(radio: Radio) -> Floats:
    """Mean strength at `COMPARED_M` in front of the vehicle, where no pattern has a notch. [dBm]"""
    if radio.two_ray is None:
        return mean_rssi_dbm(COMPARED_M)
    return radio.two_ray.mean_rssi_dbm(np.sqrt(COMPARED_M**2 - ANTENNA_M**2))

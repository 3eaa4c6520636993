"""Rows about paths: lost markers, a spoofed marker, all faults at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from app.decoders.cerpm.merge import merge_markers
from app.decoders.cerpm.verify import verify_packets
from app.lanes.estimate import Lane, LaneMarkers, fit_lane
from app.sensors.pose_track import PoseTrack, ReceivedPacket
from app.simulation.radio.attacks import (
    corrupt_packets,
    forge_packets,
    move_claim,
    number_entries,
    repeat_packets,
    shift_clock,
    shuffle_packets,
)
from app.simulation.radio.drive import SatelliteReceiver, drive_past
from app.simulation.radio.lanes import InstalledMarkers, TrueLane, lose_row, lose_share
from benchmarks.cerpm import scenes
from benchmarks.cerpm.path_errors import Tally, path_errors, track_errors

Result = tuple[str, Sequence[str], list[Sequence[object]]]


@dataclass(frozen=True)
class Condition:
    """Which markers are installed, which are missing, and the goal for the path."""

    name: str
    goal: tuple[float, float | None, float | None]
    """RMS [m], maximum [m], coverage."""
    per_side: int | None = None
    lose: Callable[[InstalledMarkers, np.random.Generator], InstalledMarkers] | None = None
    with_track: bool = True
    longest_m: float = np.inf
    """Longer lanes are cut. [m]"""


CONDITIONS = (
    Condition("40 ft", (0.025, 0.20, 0.998)),
    Condition("40 ft, 20 % lost", (0.04, None, None), lose=lambda m, r: lose_share(m, 0.2, r)),
    Condition("40 ft, 40 % lost", (0.07, 0.40, None), lose=lambda m, r: lose_share(m, 0.4, r)),
    Condition("40 ft, five in a row lost, no sides", (0.05, None, None), lose=lambda m, r: _gap(m, r)),
    Condition("ten a side", (0.10, None, None), 10),
    Condition("ten a side, 40 % lost", (0.17, None, None), 10, lambda m, r: lose_share(m, 0.4, r)),
    Condition("ten a side, markers alone", (0.13, None, None), 10, with_track=False),
    Condition("ten a side of at most 300 m, markers alone", (0.13, None, None), 10, with_track=False, longest_m=300.0),
)
CURVATURE_GOAL_PER_M = 0.003


def _gap(markers: InstalledMarkers, rng: np.random.Generator) -> InstalledMarkers:
    return lose_row(markers, 5, rng).without_sides()


def met(yes: bool) -> str:
    """Yes or no, as the tables print it."""
    return "yes" if yes else "**no**"


def runs_of(short: bool) -> tuple[int, int]:
    """Runs, and made lanes in each."""
    return (2, 3) if short else (10, 8)


def run_path(seed: int, short: bool) -> Result:
    """Condition by condition, lane by lane."""
    rows: list[Sequence[object]] = []
    names = (*scenes.ROUTE_NAMES, scenes.MADE)
    curvature, all_rows = Tally(), Tally()
    for number, condition in enumerate(CONDITIONS):
        ours = {name: Tally() for name in names}
        paper, own = Tally(), Tally()
        for name, lane, rng in list_scenes(seed, short, 10 + number):
            add_errors(condition, scenes.shortened(lane, condition.longest_m), rng, ours[name], paper, own)
        every = Tally()
        for tally in ours.values():
            every.add(tally)
        all_rows.add(every)
        if number == 0:
            curvature = every
        rows.append(_path_row(condition, ours, every, paper, own))
    got = curvature.curvature_rms_per_m
    confidence, right = (100 * share for share in all_rows.confidence_and_share_right)
    note = (
        "RMS distance from the true centre line to the path [m], by lane; maximum and coverage over all lanes. The "
        'goal is met if the RMS on each route, and on the generated lanes together, meets it. "Own track" uses the '
        'vehicle\'s positions as the path. "Bound" is the standard deviation that the markers leave on all lanes '
        "together at best: the Cramér-Rao bound, with the smoothness that was fitted as a prior.\n\n"
        f"Curvature at 40 ft: {got:.4f} 1/m RMS, goal {CURVATURE_GOAL_PER_M}, met: {met(got <= CURVATURE_GOAL_PER_M)}. "
        "Over all rows, the mean confidence that a station is within 0.25 m of the centre is "
        f"{confidence:.1f} %; {right:.1f} % are."
    )
    head = (
        "markers", "Karlsruhe low", "Karlsruhe moderate", "TFHRC bend", "TFHRC low", "made", "all", "bound", "max [m]",
        "coverage", "goal", "met", "paper's method", "own track",
    )  # fmt: skip
    return note, head, rows


def list_scenes(seed: int, short: bool, item: int):  # type: ignore[no-untyped-def]
    """Name, lane and generator of each run of an item."""
    runs, made = runs_of(short)
    for run in range(runs):
        for k, (name, lane) in enumerate(scenes.list_lanes(seed, run, made)):
            yield name, lane, np.random.default_rng([seed, item, run, k])


def add_errors(
    condition: Condition, lane: TrueLane, rng: np.random.Generator, ours: Tally, paper: Tally, own: Tally
) -> None:
    """Errors of the path, of the paper's method and of the vehicle's own track on one drive."""
    installed = scenes.install(lane, rng, condition.per_side)
    if condition.lose is not None:
        installed = condition.lose(installed, rng)
    track = scenes.track(lane, rng)
    first, last = span_of(installed)
    markers, hint = scenes.markers_for_lane(installed), track if condition.with_track else None
    ours.add(path_errors(lane, fit_lane(markers, hint), first, last))
    paper.add(path_errors(lane, fit_lane(markers, hint, method="paper"), first, last))
    own.add(track_errors(lane, track, first, last))


def span_of(installed: InstalledMarkers) -> tuple[float, float]:
    """Chainages of the first and the last marker. [m]"""
    return float(installed.chainage_m.min()), float(installed.chainage_m.max())


def _path_row(condition: Condition, ours: dict[str, Tally], every: Tally, paper: Tally, own: Tally) -> Sequence[object]:
    rms, worst, coverage = condition.goal
    good = all(tally.rms_m <= rms for tally in ours.values()) and not every.refused
    good = good and (worst is None or every.worst_m <= worst) and (coverage is None or every.coverage >= coverage)
    goal = f"{rms}" + (f", max {worst:.2f}" if worst else "") + (f", {100 * coverage:.1f} %" if coverage else "")
    refused = f" ({paper.refused} refused)" if paper.refused else ""
    return (
        condition.name, *(f"{tally.rms_m:.3f}" for tally in (*ours.values(), every)),
        f"{every.bound_m:.3f}", f"{every.worst_m:.2f}", f"{100 * every.coverage:.2f} %", goal,
        met(good), f"{paper.rms_m:.3f}{refused}", f"{own.rms_m:.3f}",
    )  # fmt: skip


# --- a spoofed marker ---------------------------------------------------------------------------------------------


class SpoofCase(NamedTuple):
    """Markers of which one sends a position 30 m off, and the goal for the path's RMS error [m]."""

    name: str
    per_side: int | None
    sides: bool
    lost: float
    goal: float | None


SPOOF_CASES = (
    SpoofCase("40 ft", None, True, 0.0, 0.045), SpoofCase("40 ft, no sides", None, False, 0.0, None),
    SpoofCase("40 ft, 20 % lost", None, True, 0.2, None), SpoofCase("ten a side", 10, True, 0.0, None),
)  # fmt: skip


def spoofed_markers(
    case: SpoofCase, lane: TrueLane, rng: np.random.Generator
) -> tuple[InstalledMarkers, int, PoseTrack, tuple[float, float]]:
    """Markers, the row of the spoofed one, a track, and the chainages of the first and the last true marker."""
    installed = lose_share(scenes.install(lane, rng, case.per_side), case.lost, rng)
    installed = installed if case.sides else installed.without_sides()
    row = int(rng.integers(len(installed)))
    spoofed = move_claim(lane, installed, row, rng)
    track = scenes.track(lane, rng)
    return spoofed, row, track, span_of(spoofed.chosen(np.arange(len(installed)) != row))


def run_spoof(seed: int, short: bool) -> Result:
    """A marker that sends a position 30 m off, with its valid tag."""
    rows: list[Sequence[object]] = []
    for number, case in enumerate(SPOOF_CASES):
        path, paper, named, runs, others, rejected = Tally(), Tally(), 0, 0, 0, 0
        for _name, lane, rng in list_scenes(seed, short, 30 + number):
            spoofed, row, track, (first, last) = spoofed_markers(case, lane, rng)
            markers = scenes.markers_for_lane(spoofed)
            lane_found = fit_lane(markers, track)
            out = {one.row for one in lane_found.left_out}
            named += row in out
            rejected += len(out - {row})
            runs, others = runs + 1, others + len(spoofed) - 1
            path.add(path_errors(lane, lane_found, first, last))
            paper.add(path_errors(lane, fit_lane(markers, track, method="paper"), first, last))
        share = rejected / others
        goal = case.goal
        good = named == runs and share <= 0.01 and (goal is None or path.rms_m <= goal)
        rows.append(
            (
                case.name, f"{named} of {runs}", f"{100 * share:.2f} %", f"{path.rms_m:.3f}", f"{path.worst_m:.2f}",
                f"all, <= 1 %{f', {goal}' if goal else ''}", met(good), f"{paper.rms_m:.2f}",
            )
        )  # fmt: skip
    head = ("markers", "named", "others left out", "RMS [m]", "max [m]", "goal", "met", "paper's method")
    return (
        "In each run, one marker sends a position that is 30 m off, in a random direction that does not put it on a "
        "boundary of the lane.",
        head,
        rows,
    )


# --- all faults at once ---------------------------------------------------------------------------------------------


def run_dirty(seed: int, short: bool) -> Result:
    """Packet logs with all faults at once, through the verifier, with positions of 2 m."""
    rows: list[Sequence[object]] = []
    cases = (
        ("2 m, corrupt, no sides, clock off", False, (0.25, 0.97)),
        ("and 20 % dead, forged, a spoofed marker", True, (0.25, 0.97)),
    )
    for number, (name, more, (rms, coverage)) in enumerate(cases):
        tally, own, broken = Tally(), Tally(), 0
        for _name, lane, rng in list_scenes(seed, short, 40 + number):
            log = dirty_log(lane, rng, more)
            found, (first, last) = _path_or_none(log), log.span_m
            broken += found is None
            if found is not None:
                tally.add(path_errors(lane, found, first, last))
            else:
                tally.add(Tally(places=int((last - first) / 0.25), runs=1))
            own.add(track_errors(lane, log.track, first, last))
        good = broken == 0 and tally.rms_m <= rms and tally.coverage >= coverage
        rows.append(
            (
                name, tally.runs, broken, f"{tally.rms_m:.3f}", f"{tally.worst_m:.2f}", f"{100 * tally.coverage:.1f} %",
                f"0, {rms}, {100 * coverage:.0f} %", met(good), f"{own.rms_m:.2f}",
            )
        )  # fmt: skip
    head = ("log", "runs", "exceptions", "RMS [m]", "max [m]", "coverage", "goal", "met", "own track")
    note = (
        "Packet logs with markers every 40 ft pass the radio link, verification and merging; no position is "
        "registered. A tenth of the packets are corrupt, a third are duplicated, the order is mixed, and the clock is "
        "up to 10 s off."
    )
    return note, head, rows


class DirtyLog(NamedTuple):
    """A packet log with faults, its keys and track, and the chainages of the first and the last marker received."""

    packets: list[ReceivedPacket]
    keys: dict[int, bytes]
    track: PoseTrack
    span_m: tuple[float, float]


def dirty_log(lane: TrueLane, rng: np.random.Generator, more: bool) -> DirtyLog:
    """Drive past markers, and add faults to the log; with `more`, dead, forged and spoofed markers too."""
    installed = scenes.install(lane, rng).without_sides()
    keys = scenes.keys_for(installed)
    if more:
        installed = lose_share(installed, 0.2, rng)
        installed = move_claim(lane, installed, int(rng.integers(1, len(installed) - 1)), rng)
    drive = drive_past(lane, installed, rng, sign=scenes.sign, receiver=SatelliteReceiver.plain())
    log = corrupt_packets(drive.packets, 0.1, rng)
    if more:
        log += forge_packets(drive.packets, len(log) // 20, rng)
    log = shuffle_packets(repeat_packets(log, 0.3, rng), rng)
    log = number_entries(shift_clock(log, float(rng.uniform(-10, 10))))
    return DirtyLog(log, keys, drive.track, span_of(installed.chosen(np.unique(drive.sender))))


def markers_of_log(log: DirtyLog) -> LaneMarkers:
    """The markers of a log, verified and merged."""
    return scenes.markers_from_merged(merge_markers(verify_packets(log.packets, log.keys).packets, {}, log.track))


def _path_or_none(log: DirtyLog) -> Lane | None:
    """The path of a log; None where an exception was raised."""
    try:
        return fit_lane(markers_of_log(log), log.track)
    except Exception as error:  # noqa: BLE001 - exceptions are counted
        print(f"raised: {error!r}")
        return None

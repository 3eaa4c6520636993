"""Rows about paths: losses, a spoofed marker, everything dirty at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from app.decoders.cerpm.lane import Lane, fit_lane
from app.decoders.cerpm.merge import merge_markers
from app.decoders.cerpm.verify import verify_packets
from app.simulation.radio.attacks import (
    corrupt_packets,
    forge_packets,
    move_claim,
    number_entries,
    repeat_packets,
    shift_clock,
    shuffle_packets,
)
from app.simulation.radio.drive import drive_past
from app.simulation.radio.lanes import TrueLane
from app.simulation.radio.markers import LaidMarkers, lose_row, lose_share
from app.simulation.radio.vehicle import Receiver
from benchmarks.cerpm import scenes
from benchmarks.cerpm.judge import Tally, judge_path, judge_track

Result = tuple[str, Sequence[str], list[Sequence[object]]]


@dataclass(frozen=True)
class Condition:
    """What is laid, what is missing, and what is asked of the path."""

    name: str
    goal: tuple[float, float | None, float | None]
    """RMS [m], maximum [m], coverage."""
    per_side: int | None = None
    lose: Callable[[LaidMarkers, np.random.Generator], LaidMarkers] | None = None
    with_track: bool = True
    longest_m: float = np.inf
    """Lanes are cut to this. [m]"""


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
CURVATURE_GOAL_1PM = 0.003


def _gap(markers: LaidMarkers, rng: np.random.Generator) -> LaidMarkers:
    return lose_row(markers, 5, rng).without_sides()


def met(yes: bool) -> str:
    """As the tables say it."""
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
        for name, lane, rng in _scenes(seed, short, 10 + number):
            add_errors(condition, scenes.shortened(lane, condition.longest_m), rng, ours[name], paper, own)
        every = Tally()
        for tally in ours.values():
            every.add(tally)
        all_rows.add(every)
        if number == 0:
            curvature = every
        rows.append(_path_row(condition, ours, every, paper, own))
    got = curvature.curvature_rms_1pm
    told, right = (100 * share for share in all_rows.told_and_right)
    note = (
        "RMS distance from the true centre line to the path [m], by lane; maximum and coverage over all lanes. Met: "
        "RMS on each route and on the made lanes together. Own track: the vehicle's positions taken as the path.\n\n"
        f"Curvature at 40 ft: {got:.4f} 1/m RMS, goal {CURVATURE_GOAL_1PM}, met: {met(got <= CURVATURE_GOAL_1PM)}. "
        f"Over all rows the paths give {told:.1f} % for being within 0.25 m of the centre; {right:.1f} % is."
    )
    head = (
        "markers", "Karlsruhe low", "Karlsruhe moderate", "TFHRC bend", "TFHRC low", "made", "all", "max [m]",
        "coverage", "goal", "met", "paper's way", "own track",
    )  # fmt: skip
    return note, head, rows


def _scenes(seed: int, short: bool, item: int):  # type: ignore[no-untyped-def]
    runs, made = runs_of(short)
    for run in range(runs):
        for k, (name, lane) in enumerate(scenes.list_lanes(seed, run, made)):
            yield name, lane, np.random.default_rng([seed, item, run, k])


def add_errors(
    condition: Condition, lane: TrueLane, rng: np.random.Generator, ours: Tally, paper: Tally, own: Tally
) -> None:
    """Errors of the path, of the paper's way and of the vehicle's own track on one drive."""
    laid = scenes.lay(lane, rng, condition.per_side)
    if condition.lose is not None:
        laid = condition.lose(laid, rng)
    track = scenes.track(lane, rng)
    first, last = span_of(laid)
    markers, hint = scenes.markers_for_lane(laid), track if condition.with_track else None
    ours.add(judge_path(lane, fit_lane(markers, hint), first, last))
    paper.add(judge_path(lane, fit_lane(markers, hint, method="paper"), first, last))
    own.add(judge_track(lane, track, first, last))


def span_of(laid: LaidMarkers) -> tuple[float, float]:
    """Chainages of the first and the last marker. [m]"""
    return float(laid.chainage_m.min()), float(laid.chainage_m.max())


def _path_row(condition: Condition, ours: dict[str, Tally], every: Tally, paper: Tally, own: Tally) -> Sequence[object]:
    rms, worst, coverage = condition.goal
    good = all(tally.rms_m <= rms for tally in ours.values()) and not every.refused
    good = good and (worst is None or every.worst_m <= worst) and (coverage is None or every.coverage >= coverage)
    goal = f"{rms}" + (f", max {worst:.2f}" if worst else "") + (f", {100 * coverage:.1f} %" if coverage else "")
    refused = f" ({paper.refused} refused)" if paper.refused else ""
    return (
        condition.name, *(f"{tally.rms_m:.3f}" for tally in (*ours.values(), every)), f"{every.worst_m:.2f}",
        f"{100 * every.coverage:.2f} %", goal, met(good), f"{paper.rms_m:.3f}{refused}", f"{own.rms_m:.3f}",
    )  # fmt: skip


# --- a spoofed marker ---------------------------------------------------------------------------------------------


def run_spoof(seed: int, short: bool) -> Result:
    """A marker that claims a place 30 m off, with its right tag."""
    rows: list[Sequence[object]] = []
    cases: tuple[tuple[str, int | None, bool, float, float | None], ...] = (
        ("40 ft", None, True, 0.0, 0.045), ("40 ft, no sides", None, False, 0.0, None),
        ("40 ft, 20 % lost", None, True, 0.2, None), ("ten a side", 10, True, 0.0, None),
    )  # fmt: skip
    for number, (name, per_side, sides, lost, goal) in enumerate(cases):
        path, paper, named, runs, others, rejected = Tally(), Tally(), 0, 0, 0, 0
        for _name, lane, rng in _scenes(seed, short, 30 + number):
            laid = lose_share(scenes.lay(lane, rng, per_side), lost, rng)
            laid = laid if sides else laid.without_sides()
            row = int(rng.integers(len(laid)))
            spoofed = move_claim(lane, laid, row, rng)
            markers, track = scenes.markers_for_lane(spoofed), scenes.track(lane, rng)
            first, last = span_of(spoofed.chosen(np.arange(len(laid)) != row))
            lane_found = fit_lane(markers, track)
            out = {one.row for one in lane_found.left_out}
            named += row in out
            rejected += len(out - {row})
            runs, others = runs + 1, others + len(laid) - 1
            path.add(judge_path(lane, lane_found, first, last))
            paper.add(judge_path(lane, fit_lane(markers, track, method="paper"), first, last))
        share = rejected / others
        good = named == runs and share <= 0.01 and (goal is None or path.rms_m <= goal)
        rows.append(
            (
                name, f"{named} of {runs}", f"{100 * share:.2f} %", f"{path.rms_m:.3f}", f"{path.worst_m:.2f}",
                f"all, <= 1 %{f', {goal}' if goal else ''}", met(good), f"{paper.rms_m:.2f}",
            )
        )  # fmt: skip
    head = ("markers", "named", "others left out", "RMS [m]", "max [m]", "goal", "met", "paper's way")
    return "One marker of each run claims a place 30 m off in any direction that is on no line of the lane.", head, rows


# --- everything dirty ---------------------------------------------------------------------------------------------


def run_dirty(seed: int, short: bool) -> Result:
    """Packet logs with all faults at once, through the verifier, with positions of 2 m."""
    rows: list[Sequence[object]] = []
    cases = (
        ("2 m, corrupt, no sides, clock off", False, (0.25, 0.97)),
        ("and 20 % dead, forged, a spoofed marker", True, (0.25, 0.97)),
    )
    for number, (name, more, (rms, coverage)) in enumerate(cases):
        tally, own, broken = Tally(), Tally(), 0
        for _name, lane, rng in _scenes(seed, short, 40 + number):
            found, log_track, (first, last), raised = dirty_path(lane, rng, more)
            broken += raised
            if found is not None:
                tally.add(judge_path(lane, found, first, last))
            else:
                tally.add(Tally(places=int((last - first) / 0.25), runs=1))
            own.add(judge_track(lane, log_track, first, last))
        good = broken == 0 and tally.rms_m <= rms and tally.coverage >= coverage
        rows.append(
            (
                name, tally.runs, broken, f"{tally.rms_m:.3f}", f"{tally.worst_m:.2f}", f"{100 * tally.coverage:.1f} %",
                f"0, {rms}, {100 * coverage:.0f} %", met(good), f"{own.rms_m:.2f}",
            )
        )  # fmt: skip
    head = ("log", "runs", "exceptions", "RMS [m]", "max [m]", "coverage", "goal", "met", "own track")
    note = (
        "Packet logs at 40 ft through link, verifier and merger, no place registered: a tenth of the packets corrupt, "
        "a third twice, out of order, the clock up to 10 s off."
    )
    return note, head, rows


def dirty_path(lane: TrueLane, rng: np.random.Generator, more: bool):  # type: ignore[no-untyped-def]
    """Path or None, track, span of the markers heard, and whether anything was raised."""
    laid = scenes.lay(lane, rng).without_sides()
    keys = scenes.keys_for(laid)
    if more:
        laid = lose_share(laid, 0.2, rng)
        laid = move_claim(lane, laid, int(rng.integers(1, len(laid) - 1)), rng)
    heard = drive_past(lane, laid, rng, sign=scenes.sign, receiver=Receiver.plain())
    log = corrupt_packets(heard.packets, 0.1, rng)
    if more:
        log += forge_packets(heard.packets, len(log) // 20, rng)
    log = shuffle_packets(repeat_packets(log, 0.3, rng), rng)
    log = number_entries(shift_clock(log, float(rng.uniform(-10, 10))))
    span = span_of(laid.chosen(np.unique(heard.sender)))
    found: Lane | None = None
    try:
        merged = merge_markers(verify_packets(log, keys).packets, {}, heard.track)
        found = fit_lane(scenes.markers_from_merged(merged), heard.track)
    except Exception as error:  # noqa: BLE001 - what is counted here
        print(f"raised: {error!r}")
        return None, heard.track, span, 1
    return found, heard.track, span, 0

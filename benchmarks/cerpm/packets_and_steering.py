"""Rows about forgeries, steering, the radio and speed."""

from __future__ import annotations

import csv
import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from app.decoders.cerpm.merge import merge_markers
from app.decoders.cerpm.verify import SequenceSpan, Verdict, verify_packets
from app.lanes.control import Controller
from app.lanes.estimate import fit_lane
from app.sensors.pose_track import ReceivedPacket
from app.simulation.radio.attacks import forge_packets, number_entries, replay_packets
from app.simulation.radio.drive import SimulatedDrive, drive_past, marker_message
from app.simulation.radio.lanes import InstalledMarkers, TrueLane, make_lane
from app.simulation.radio.link import Radio, mean_rssi_dbm, receive_transmissions, send_beacons
from app.simulation.steering import PoseNoise, SteeringCheck, check_steering
from benchmarks.cerpm import scenes
from benchmarks.cerpm.paths import Result, met, runs_of
from benchmarks.scenes.road_shapes import RoadShape, lane_of_shape

REFERENCE = Path(__file__).parents[1] / "reference" / "cerpm.csv"
_DAY_S = 86_400.0
Spans = Mapping[int, Sequence[SequenceSpan]]
Method = Literal["waymark", "paper"]


def paper_figure(quantity: str) -> float:
    """A figure of the paper."""
    with REFERENCE.open() as file:
        for row in csv.DictReader(line for line in file if not line.startswith("#")):
            if row["quantity"] == quantity:
                return float(row["value"])
    raise KeyError(quantity)


# --- forged and replayed packets ----------------------------------------------------------------------------------


def run_forged(seed: int, short: bool) -> Result:
    """10,000 forged or replayed packets among those of drives on three days."""
    rng = np.random.default_rng([seed, 50])
    lane = scenes.route("tfhrc_bend_1")
    installed = scenes.install(lane, rng)
    keys = scenes.keys_for(installed)
    counts = (400, 200, 200, 200) if short else (4000, 2000, 2000, 2000)
    days = _days(lane, installed, rng)
    rows: list[Sequence[object]] = []

    def row(name: str, result: tuple[int, int, dict[Verdict, int], int, int], goal: bool) -> None:
        sent, accepted, verdicts, real, kept = result
        counts_text = ", ".join(f"{n} {v}" for v, n in verdicts.items() if n)
        good = accepted == 0 and kept >= 0.995 * real  # refusing every packet is no solution
        rows.append(
            (name, sent, accepted, 0 if goal else "-", met(good) if goal else "-", f"{kept} of {real}", counts_text)
        )

    forged = forge_packets(days[0].packets, counts[0], rng)
    row("forged", _attack(days[0].packets, forged, keys, {})[0], True)
    start, end = days[0].packets[0].received_at_s, days[0].packets[-1].received_at_s
    again = replay_packets(days[0].packets, 4 * counts[1], rng, at_s=(start, end + 30))
    same = [packet for packet in again if _is_later(packet, days[0])][: counts[1]]
    row("replayed in the drive that heard them", _attack(days[0].packets, same, keys, {})[0], True)
    _result, spans = _attack(days[0].packets, [], keys, {})
    next_day = replay_packets(days[0].packets, counts[2], rng, at_s=_times(days[1]))
    result, spans_1 = _attack(days[1].packets, next_day, keys, spans)
    row("replayed in the next day's drive", result, True)
    kept = {**spans, **{n: (*spans.get(n, ()), *more) for n, more in spans_1.items()}}
    restored = _through_text(kept)
    both = (*days[0].packets, *days[1].packets)
    third = replay_packets(both, counts[3], rng, at_s=_times(days[2]))
    row("replayed on the third day, after a restart", _attack(days[2].packets, third, keys, restored)[0], True)
    alone = replay_packets(both, counts[3], rng, at_s=_times(days[2]))
    row("the same with no marker on the air", _attack([], alone, keys, restored)[0], True)
    unheard = replay_packets(_all_sent(days[1], installed), counts[3], rng, at_s=_times(days[2]))
    row("recorded by others, replayed beside the markers", _attack(days[2].packets, unheard, keys, restored)[0], False)
    row("recorded 5 km away, of markers never heard", _from_afar(lane, days[2], keys, counts[3], rng), True)
    head = ("packets", "attacks", "accepted", "goal", "met", "real ones accepted", "verdicts on attacks")
    note = (
        "The stored sequences are written to text and read back between the second and the third day. In the "
        "second-to-last row, an attacker's receiver recorded on the second day what the vehicle did not receive; the "
        "replayed packets have the content that their markers send anyway. In the last row, no position is registered, "
        "and a packet counts as accepted if its marker is used after merging with the vehicle's track."
    )
    return note, head, rows


def _days(lane, installed: InstalledMarkers, rng: np.random.Generator) -> list[SimulatedDrive]:  # type: ignore[no-untyped-def]
    """Drives a day apart; sequences go on between them."""
    first = rng.integers(0, 10_000, len(installed))
    a_day = int(_DAY_S / Radio().interval_s)
    return [
        drive_past(
            lane, installed, rng, sign=scenes.sign, start_s=1.78e9 + day * _DAY_S, first_sequence=first + day * a_day
        )
        for day in range(3)
    ]


def _attack(
    real: Sequence[ReceivedPacket], attack: Sequence[ReceivedPacket], keys: Mapping[int, bytes], spans: Spans
) -> tuple[tuple[int, int, dict[Verdict, int], int, int], dict[int, tuple[SequenceSpan, ...]]]:
    """Attacks sent and accepted, their verdicts, real packets and how many of them were accepted; and the spans."""
    ours = [(p, False) for p in real] + [(p, True) for p in attack]
    ours.sort(key=lambda one: one[0].received_at_s)
    log = number_entries([p for p, _bad in ours])
    found = verify_packets(log, keys, spans)
    verdicts = dict.fromkeys(Verdict, 0)
    accepted = kept = 0
    for packet, (_heard, bad) in zip(found.packets, ours, strict=True):
        if bad:
            verdicts[packet.verdict] += 1
            accepted += packet.accepted
        else:
            kept += packet.accepted
    return (len(attack), accepted, verdicts, len(real), kept), found.spans


def _from_afar(  # type: ignore[no-untyped-def]
    lane, drive: SimulatedDrive, keys: Mapping[int, bytes], count: int, rng: np.random.Generator
) -> tuple[int, int, dict[Verdict, int], int, int]:
    """Packets of another road's markers, fresh by their bytes, sent where the vehicle is."""
    lon, lat, height = lane.origin
    afar = make_lane(rng, origin=(lon + 0.06, lat, height))
    installed = scenes.install(afar, rng)
    installed = replace(installed, number=installed.number + 100_000)
    recorded = _all_sent(
        drive_past(afar, installed, rng, sign=scenes.sign, start_s=drive.packets[0].received_at_s - 600), installed
    )
    attack = replay_packets(recorded, count, rng, at_s=_times(drive))
    log = number_entries(sorted([*drive.packets, *attack], key=lambda p: p.received_at_s))
    found = verify_packets(log, {**keys, **scenes.keys_for(installed)})
    used = set(merge_markers(found.packets, {}, drive.track).number.tolist())
    alien, verdicts, accepted, kept = set(installed.number.tolist()), dict.fromkeys(Verdict, 0), 0, 0
    for packet in found.packets:
        if packet.number in alien:
            verdicts[packet.verdict] += 1
            accepted += packet.accepted and packet.number in used
        else:
            kept += packet.accepted and packet.number in used
    return count, accepted, verdicts, len(drive.packets), kept


def _is_later(packet: ReceivedPacket, drive: SimulatedDrive) -> bool:
    """Whether a replayed packet is later than the original."""
    first = {p.payload: p.received_at_s for p in drive.packets}
    return packet.received_at_s > first[packet.payload] + 0.01


def _times(drive: SimulatedDrive) -> tuple[float, float]:
    return drive.packets[0].received_at_s, drive.packets[-1].received_at_s


def _through_text(spans: Spans) -> dict[int, tuple[SequenceSpan, ...]]:
    text = json.dumps({n: [asdict(s) for s in some] for n, some in spans.items()})
    return {int(n): tuple(SequenceSpan(**s) for s in some) for n, some in json.loads(text).items()}


def _all_sent(drive: SimulatedDrive, installed: InstalledMarkers) -> list[ReceivedPacket]:
    """Packets that a recorder beside the road received and the vehicle did not."""
    received = scenes.payload_of(drive.packets)
    out: list[ReceivedPacket] = []
    for sender, sequence, start in zip(drive.sent.sender, drive.sent.sequence, drive.sent.start_s, strict=True):
        payload = scenes.sign(marker_message(installed, int(sender), int(sequence)))
        if payload not in received:
            out.append(ReceivedPacket(len(out), float(start), payload=payload, rssi_dbm=-90.0))
    return out


# --- steering -----------------------------------------------------------------------------------------------------


class TrackingRow:
    """Simulated drives of one controller, for a row of a table."""

    HEAD = (
        "RMS [m]", "max [m]", "worst run", "MSE [m2]", "worst run", "steering rate, RMS and largest [deg/s]",
        "time per step [µs]",
    )  # fmt: skip

    def __init__(self, law: Controller) -> None:
        self.law = law
        self.checks: list[SteeringCheck] = []
        self.cpu_s = 0.0

    def drive(self, lane: TrueLane, per_side: int | None, rng: np.random.Generator, method: Method = "waymark") -> None:
        """Install markers, decode the lane's path, and drive along it."""
        installed = scenes.install(lane, rng, per_side)
        path = fit_lane(scenes.markers_for_lane(installed), scenes.track(lane, rng), method=method)
        line = lane.enu_from_wgs84(path.lon_deg, path.lat_deg)
        start = time.thread_time()
        check = check_steering(
            line, scenes.LIMIT.km_h, controller=self.law, noise=PoseNoise(), truth_enu_m=lane.centre_m, rng=rng
        )
        self.cpu_s += time.thread_time() - start
        self.checks.append(check)

    @property
    def rms_m(self) -> float:
        """Of all drives."""
        return float(np.sqrt(np.mean([check.rms_m**2 for check in self.checks])))

    @property
    def mse_m2(self) -> float:
        """Mean of the drives."""
        return float(np.mean([check.mse_m2 for check in self.checks]))

    @property
    def ended_early(self) -> int:
        """Drives that did not reach the end."""
        return sum(not check.completed for check in self.checks)

    def cells(self) -> tuple[str, ...]:
        """In the order of ``HEAD``."""
        rates = [check.steer_rate_rms_deg_s for check in self.checks]
        steps = sum(len(check.trace.time_s) for check in self.checks)
        return (
            f"{self.rms_m:.3f}", f"{max(check.max_m for check in self.checks):.2f}",
            f"{max(check.rms_m for check in self.checks):.3f}", f"{self.mse_m2:.5f}",
            f"{max(check.mse_m2 for check in self.checks):.5f}",
            f"{np.sqrt(np.mean(np.square(rates))):.2f}, {max(check.steer_rate_max_deg_s for check in self.checks):.1f}",
            f"{1e6 * self.cpu_s / steps:.0f}",
        )  # fmt: skip


def run_tracking(seed: int, short: bool) -> Result:
    """A simulated car along decoded paths, against the true centre line."""
    rows: list[Sequence[object]] = []
    cases = (
        ("40 ft, predictive", None, Controller.PREDICTIVE, (0.001, 0.03)),
        ("40 ft, model predictive", None, Controller.MPC, (0.001, 0.03)),
        ("40 ft, Stanley", None, Controller.STANLEY, None),
        ("40 ft, Stanley with 15 m look-ahead", None, Controller.STANLEY_LOOKAHEAD, None),
        ("ten a side, predictive", 10, Controller.PREDICTIVE, (0.01, None)),
        ("ten a side, model predictive", 10, Controller.MPC, (0.01, None)),
    )
    runs, made = runs_of(short)
    _compile_controllers()
    for name, per_side, law, goal in cases:
        row = TrackingRow(law)
        for run in range(runs):
            for k, (_name, lane) in enumerate(scenes.list_lanes(seed, run, made)):
                row.drive(lane, per_side, np.random.default_rng([seed, 60, run, k]))
        met_goal = goal is None or (row.mse_m2 <= goal[0] and (goal[1] is None or row.rms_m <= goal[1]))
        goal_text = "-" if goal is None else f"{goal[0]}" + (f", RMS {goal[1]}" if goal[1] else "")
        good = "-" if goal is None else met(met_goal and not row.ended_early)
        rows.append((name, *row.cells(), goal_text, good))
    return (
        "Distance of the front axle from the true centre line; poses with RTK noise; at most 25 mph in bends. All "
        "controllers drive along the same paths with the same errors of poses. Time per step is the processor time of "
        "the controller and of the simulated car, at 100 steps a second. The "
        "paper's 0.42 and 0.38 m (table 1) are not comparable, because neither is a distance across the path. They "
        "are labelled mean squared errors but given in metres: 0.42 is the magnitude of route 2's components 0.25 and "
        "0.34, while 0.38 is only the Y component of route 3 (0.24 and 0.38).",
        ("path, controller", *TrackingRow.HEAD, "goal", "met"),
        rows,
    )


def _compile_controllers() -> None:
    """Compile, so that no measured drive waits for it."""
    line_m = np.column_stack([np.arange(50.0), np.zeros(50)])
    for law in Controller:
        check_steering(line_m, 30.0, controller=law, noise=PoseNoise(), rng=np.random.default_rng(0))


# --- the paper's routes -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PaperRoute:
    """A test route of the CERPM paper, as far as it is described there; the rest is drawn."""

    name: str
    length_m: float
    radius_m: tuple[float, float]  # of its bends: smallest and largest that are drawn
    turn_deg: tuple[float, float]  # of each of its bends, likewise
    bends: int  # one or two
    clothoid_m: float
    per_side: int  # markers
    paper: str  # table 1


def paper_routes() -> tuple[PaperRoute, ...]:
    """The three routes.

    Notes
    -----
    Stated (sections 3 and 4): ten markers on route 1, of which one was 50 m from its start and received until 340 m
    further on; ten markers on either side, across from each other, on routes 2 and 3, with their lengths; the camera
    fails above a curvature of 0.016 / m, and saw both lines on 6.7 % of route 2 and on 86.1 % of route 3. Assumed: the
    length of route 1 and its gentle bends; on route 2, after a straight of 6.7 %, one bend with a curvature just above
    0.016 / m; on route 3 two bends below half of that curvature; 25 mph; a lane of 3.3 m; markers at even distances.
    """
    fails_m = 1 / paper_figure("curvature beyond which the camera fails")
    per_side = int(paper_figure("markers per lane side on a route"))
    steep_m, low_m = (paper_figure(f"route {n} length ({how} curvature)") for n, how in ((2, "steep"), (3, "low")))
    errors_m = [f"{paper_figure(f'controller path error route {n}'):g}" for n in (2, 3)]
    return (
        PaperRoute("1, Oak Ridge", 390.0, (200.0, 400.0), (10.0, 30.0), 2, 30.0, per_side // 2, "-"),
        PaperRoute(
            "2, steep", steep_m, (0.85 * fails_m, 0.95 * fails_m), (250.0, 250.0), 1, 10.0, per_side, errors_m[0]
        ),
        PaperRoute("3, low curvature", low_m, (2 * fails_m, 6 * fails_m), (20.0, 40.0), 2, 30.0, per_side, errors_m[1]),
    )


def draw_route(route: PaperRoute, rng: np.random.Generator) -> TrueLane:
    """A lane that has what the paper states of a route."""
    radius_m, second_m = rng.uniform(*route.radius_m, 2)
    straight_m = 0.067 * route.length_m
    longest_deg = math.degrees((route.length_m - straight_m - route.clothoid_m) / radius_m)  # ends with the route
    return lane_of_shape(
        RoadShape(
            route.length_m,
            radius_m=float(radius_m),
            turn_deg=float(min(rng.uniform(*route.turn_deg), longest_deg)),
            clothoid_m=route.clothoid_m,
            second_radius_m=float(second_m),
            second_turn_deg=float(rng.uniform(*route.turn_deg)) if route.bends == 2 else 0.0,
            straight_m=straight_m,
            turns_left=bool(rng.random() < 0.5),
            heading_deg=float(rng.uniform(0.0, 360.0)),
        )
    )


def run_routes(seed: int, short: bool) -> Result:
    """The paper's three routes, with its own way and with others."""
    rows: list[Sequence[object]] = []
    ways: tuple[tuple[str, Method, Controller], ...] = (
        ("paper's path, Stanley with 15 m look-ahead", "paper", Controller.STANLEY_LOOKAHEAD),
        ("paper's path, Stanley", "paper", Controller.STANLEY),
        ("Stanley", "waymark", Controller.STANLEY),
        ("predictive", "waymark", Controller.PREDICTIVE),
        ("model predictive", "waymark", Controller.MPC),
    )
    fails_per_m = paper_figure("curvature beyond which the camera fails")
    _compile_controllers()
    for n, route in enumerate(paper_routes()):
        for name, method, law in ways:
            row, steep = TrackingRow(law), []
            for run in range(4 if short else 20):
                rng = np.random.default_rng([seed, 61, n, run])
                lane = draw_route(route, rng)
                steep.append(100 * np.mean(np.abs(lane.curvature_per_m) > fails_per_m))
                row.drive(lane, route.per_side, rng, method)
            drives = f"{len(row.checks) - row.ended_early} of {len(row.checks)}"
            rows.append((f"{route.name}: {name}", f"{np.mean(steep):.0f} %", drives, *row.cells(), route.paper))
    return (
        "The paper's test routes, as far as it describes them: route 1 with five markers a side, of 390 m, because one "
        "marker was 50 m from its start and received until 340 m further on; routes 2 (275 m) and 3 (350 m) with ten a "
        "side. Their geometry is not published. Drawn are: on route 2 a straight of 6.7 % (where the camera saw both "
        "lines) and one bend of 53 to 59 m; on route 3 two bends of 125 to 375 m; on route 1 two of 200 to 400 m. "
        "Steep is the share above the curvature of 0.016 / m at which the camera fails. "
        "At most 25 mph, poses with RTK noise. Paths are the decoder's or, where stated, the paper's (section 2.2). "
        "The paper's errors are not distances across the path (see the table of tracking).",
        ("route, controller", "steep", "completed", *TrackingRow.HEAD, "paper, table 1 [m]"),
        rows,
    )


# --- radio --------------------------------------------------------------------------------------------------------


def run_radio(seed: int, short: bool) -> Result:
    """The simulation itself: is the link the paper's, and are the losses ALOHA's?"""
    rows: list[Sequence[object]] = []
    for at_m in (50, 340):
        paper = paper_figure(f"RSSI at {at_m} m")
        strengths = []
        for k in range(4 if short else 20):
            rng = np.random.default_rng([seed, 70, k])
            lane = scenes.route("tfhrc_bend_1" if k % 2 else "tfhrc_low_1")
            drive = drive_past(lane, scenes.install(lane, rng), rng, sign=None)
            near = np.abs(drive.distance_m - at_m) < 0.06 * at_m
            strengths.append(drive.strength_dbm[near] - mean_rssi_dbm(drive.distance_m[near]) + mean_rssi_dbm(at_m))
        got = float(np.concatenate(strengths).mean())
        rows.append((f"RSSI at {at_m} m [dBm]", f"{got:.1f}", f"{paper:.0f}", met(abs(got - paper) <= 1.0)))
    for count, interval_s, bandwidth_hz in ((20, 2.0, 125_000), (100, 10.0, 125_000), (20, 2.0, 500_000)):
        hard = Radio(7, bandwidth_hz, interval_s, payload_bytes=27, lock_symbols=12.25, capture_db=np.inf)
        soft = Radio(7, bandwidth_hz, interval_s, payload_bytes=27)
        rates = []
        for radio in (hard, soft):
            rng = np.random.default_rng([seed, 71, count, bandwidth_hz])
            sent = send_beacons(count, radio, 0.0, (50 if short else 400) * interval_s, rng)
            strength = rng.normal(-95, 8, len(sent.start_s))
            rates.append(receive_transmissions(sent.start_s, strength, radio, rng).mean())
        aloha = float(np.exp(-2 * count * hard.airtime_s / interval_s))
        name = f"heard of {count} markers, {interval_s:g} s, {bandwidth_hz // 1000} kHz; with capture {rates[1]:.2f}"
        rows.append((name, f"{rates[0]:.3f}", f"{aloha:.3f}", met(abs(rates[0] - aloha) <= 0.04)))
    note = (
        "Spreading factor 7, packets of 27 bytes, signal strengths with a standard deviation of 8 dB. The column "
        '"found" is the result of the simulation.'
    )
    return note, ("simulation", "found", "paper, ALOHA", "met"), rows


# --- speed --------------------------------------------------------------------------------------------------------


def run_speed(seed: int, short: bool) -> Result:
    """Time of a path on one core, and how it grows."""
    rows: list[Sequence[object]] = []
    rng = np.random.default_rng([seed, 80])
    lanes = [lane for _name, lane in scenes.list_lanes(seed, 0, 4) if lane.length_m >= 480]
    opening = [
        lane_of_shape(RoadShape(500.0, extra_m=extra_m, extra_start=0.4, extra_on_left=bool(k % 2)))
        for k, extra_m in enumerate((2.0, 3.0, 3.5))
    ]
    for name, some in (("500 m, 40 ft", lanes), ("500 m that opens by 2 to 3.5 m", opening)):
        inputs = [(scenes.markers_for_lane(scenes.install(lane, rng)), scenes.track(lane, rng)) for lane in some]
        fit_lane(*inputs[0])
        times = []
        for markers, track in inputs * (3 if short else 10):
            start = time.thread_time()
            fit_lane(markers, track)
            times.append(1000 * (time.thread_time() - start))
        middle = float(np.median(times))
        rows.append((f"{name}, track of 20 Hz [ms]", f"{middle:.1f}", 20, met(middle <= 20)))
    slopes = []
    for km in (1, 10, 30) if short else (1, 10, 100, 1000):
        markers, track = scenes.long_lane(np.random.default_rng([seed, 81, km]), 1000.0 * km)
        start = time.thread_time()
        found = fit_lane(markers, track)
        seconds = time.thread_time() - start
        slopes.append(seconds / km)
        whole = found.refusal is None and found.station_m[-1] >= 990 * km
        growth = slopes[-1] / slopes[0]
        rows.append(
            (
                f"{km} km, {len(markers)} markers, track of 10 Hz [ms a km]", f"{1000 * slopes[-1]:.1f}",
                "linear", met(whole and growth <= 1.5),
            )
        )  # fmt: skip
    return "CPU time of `fit_lane` on one core.", ("path", "time", "goal", "met"), rows

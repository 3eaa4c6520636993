"""``python -m benchmarks.track [--short] [--drives N] [--seed S]``: tracks against the truth and single sensors."""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from app.tracks import ClockState, Track, TrackInput
from app.tracks.estimate import estimate_track
from app.values import Floats
from benchmarks.track import drives
from benchmarks.track.drives import Drive, simulate
from benchmarks.track.end_to_end import print_end_to_end

_MEAN_SPEED_M_S = 12.4  # of the simulated drives


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.track", description=__doc__)
    parser.add_argument("--short", action="store_true", help="20 drives")
    parser.add_argument("--drives", type=int, help="default: 200, short: 20")
    parser.add_argument("--seed", type=int, default=50_000, help="of the first drive")
    parser.add_argument("--hours", type=float, help="only time and memory of one drive of this length")
    arguments = parser.parse_args()
    if arguments.hours:
        return _print_long(arguments.hours, arguments.seed)
    print("### track\n")
    print_end_to_end(range(7, 8 if arguments.short else 17))
    count = arguments.drives or (20 if arguments.short else 200)
    rng = np.random.default_rng(arguments.seed)
    inputs = {"all three families": _all, "bar alone: tags, speed, heading": _bar, "camera alone: plates": _camera}
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in inputs}
    nees: list[float] = []
    offsets: list[tuple[float, float]] = []
    used, lost, seconds = 0, 0, []
    wrong_total, good_total, observed = 0, 0, 0
    for seed in range(arguments.seed, arguments.seed + count):
        drive = simulate(seed)
        for name, choose in inputs.items():
            began = time.process_time()
            track = estimate_track(choose(drive.given))
            along, across, inside = _errors(drive, track)
            errors[name].append((_rms(along[inside]), _rms(across[inside])))
            if name != "all three families":
                continue
            seconds.append(time.process_time() - began)
            nees.append(_nees(drive, track, rng))
            camera = next(clock for clock in track.clocks if clock.clock == "camera")
            observed += camera.state is ClockState.ESTIMATED
            offsets.append((camera.offset_s - drive.offset_s, camera.sigma_s))
            for result in track.fixes:
                is_wrong = result.fix.place in drive.wrong
                wrong_total, good_total = wrong_total + is_wrong, good_total + (not is_wrong)
                used += is_wrong and result.used
                lost += not is_wrong and not result.used
    _print_errors(errors, count, arguments.seed)
    difference, sigma = np.array(offsets).T
    low, high = (float(chi2.ppf(level, 2 * count)) / count for level in (0.025, 0.975))
    offset_low, offset_high = (float(chi2.ppf(level, count)) / count for level in (0.025, 0.975))
    squares = float(np.mean((difference / sigma) ** 2))
    print(f"""
| figure | value | goal |
|---|---|---|
| NEES of the position, one time a drive | {np.mean(nees):.2f} | {low:.2f} to {high:.2f} (95 %) |
| offset of the camera's clock, RMS error [ms] | {1e3 * _rms(difference):.1f} | |
| its standard deviation, median [ms] | {1e3 * float(np.median(sigma)):.1f} | |
| squared error over variance, mean | {squares:.2f} | {offset_low:.2f} to {offset_high:.2f} (95 %) |
| offsets stated as estimated | {observed} of {count} | |
| wrong fixes used | {used} of {wrong_total} | 0 |
| good fixes left out | {lost} of {good_total} ({100 * lost / max(good_total, 1):.2f} %) | |
| processor time for a drive of 4 km, median [s] | {float(np.median(seconds)):.2f} | |
""")
    return 0


def _print_long(hours: float, seed: int) -> int:
    """Time and memory of fusing one long drive."""
    estimate_track(simulate(seed).given)  # compiles the filter
    drive = simulate(seed, length_m=hours * 3600.0 * _MEAN_SPEED_M_S)
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    began = time.process_time()
    track = estimate_track(drive.given)
    seconds = time.process_time() - began
    along, across, inside = _errors(drive, track)
    used = sum(result.used for result in track.fixes)
    print(f"""
| drive [h] | fixes | used | along [m] | across [m] | processor time [s] | memory before, at most [MB] |
|---|---|---|---|---|---|---|
| {(drive.time_s[-1] - drive.time_s[0]) / 3600:.2f} | {len(track.fixes)} | {used} \
| {_rms(along[inside]):.3f} | {_rms(across[inside]):.3f} | {seconds:.0f} \
| {before_mb:.0f}, {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} |
""")
    return 0


def _all(given: TrackInput) -> TrackInput:
    return given


def _bar(given: TrackInput) -> TrackInput:
    fixes = tuple(fix for fix in given.fixes if fix.clock == "bar")
    return replace(given, clocks=given.clocks[:1], fixes=fixes, paths=())


def _camera(given: TrackInput) -> TrackInput:
    fixes = tuple(fix for fix in given.fixes if fix.clock == "camera")
    return TrackInput(given.clocks[1:], fixes)


def _errors(drive: Drive, track: Track) -> tuple[Floats, Floats, np.ndarray]:
    """Errors along and across; a camera alone is on its own time: its offset is taken out."""
    alone = len(track.clocks) == 1 and track.clocks[0].clock == "camera"
    time_s = track.time_s + (drive.offset_s if alone else 0.0)
    along, across = drive.errors_m(time_s, track.lon_deg, track.lat_deg)
    fixes = [result.time_s for result in track.fixes]
    inside = (track.time_s >= min(fixes)) & (track.time_s <= max(fixes))
    return along, across, inside


def _nees(drive: Drive, track: Track, rng: np.random.Generator) -> float:
    inside = np.flatnonzero((track.time_s >= drive.time_s[0]) & (track.time_s <= drive.time_s[-1]))
    k = int(rng.choice(inside))
    along, across = drive.errors_m(track.time_s[[k]], track.lon_deg[[k]], track.lat_deg[[k]])
    psi = float(np.interp(track.time_s[k], drive.time_s, drive.heading))
    axes = np.array([[np.sin(psi), -np.cos(psi)], [np.cos(psi), np.sin(psi)]])
    error = axes @ np.array([along[0], across[0]])
    east, cross, north = track.covariance_m2[k]
    return float(error @ np.linalg.solve(np.array([[east, cross], [cross, north]]), error))


def _print_errors(errors: dict[str, list[tuple[float, float]]], count: int, seed: int) -> None:
    print(f"{count} drives of 4 km, seeds {seed} to {seed + count - 1}; between the first and the last fix.")
    print(
        f"Plates every 120 m, three frames each ({drives.PLATE_ALONG_M} m along, {drives.PLATE_ACROSS_M} m across);"
        f" tags"
        f" every 200 m ({drives.TAG_ALONG_M} m, {drives.TAG_ACROSS_M} m); path of CERPMs over 60 % of the drive"
        f" ({drives.PATH_SIGMA_M} m);\ntwo outages of 500 m, 5-10 % wrong markers, a cloned plate, clock offset to"
        f" {drives.MAX_OFFSET_S} s, speed scale {100 * drives.SPEED_SCALE:g} %, heading bias"
        f" {drives.HEADING_BIAS_DEG:g} deg.\n"
    )
    print("| sensors | along [m] | worst decile | worst drive | across [m] | worst decile | worst drive |")
    print("|---|---|---|---|---|---|---|")
    for name, pairs in errors.items():
        columns = [column for values in np.array(pairs).T for column in _figures(values)]
        print(f"| {name} | " + " | ".join(f"{value:.3f}" for value in columns) + " |")


def _figures(values: Floats) -> Sequence[float]:
    """Root of the mean square of all drives, mean of the worst tenth, worst."""
    worst = np.sort(values)[-max(len(values) // 10, 1) :]
    return _rms(values), float(worst.mean()), float(values.max())


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))


if __name__ == "__main__":
    raise SystemExit(main())

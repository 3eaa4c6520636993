"""Records to Markdown tables, each row beside the paper's figure, a peer's or a goal."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from benchmarks.plates.evaluate import PositionAccuracy, Record
from benchmarks.plates.peers import FAMILIES
from benchmarks.plates.sets import LIGHT, RENDERED_ROWS, THERMAL_KMH, WITH_PLATE, WITHOUT_PLATE, read_trials
from benchmarks.plates.speed import StageTiming, Timing

ACCURACY_ROWS = (8.0, 12.0, 16.0, 24.0, 48.0)
BINS = ((8, 10, None), (10, 12, 25), (12, 16, 75), (16, 24, 95), (24, math.inf, 99))


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Markdown table; the first column is text, the others are right-aligned."""
    lines = ["| " + " | ".join(head) + " |", "|" + "|".join(["---"] + ["--:"] * (len(head) - 1)) + "|"]
    lines += ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows]
    return "\n".join(lines)


def trials_table(records: Sequence[Record]) -> str:
    """Frames decoded in the paper's trials, a drive's mean over the seeds."""
    rows = []
    for trial in read_trials():
        mine = [r for r in records if r.set_name == "trial" and r.label == f"{trial.figure}/{trial.trial}"]
        seeds = sorted({r.seed for r in mine})
        if not seeds:
            continue
        decoded = [_scaled(r for r in mine if r.seed == s and r.decoded) for s in seeds]
        known = [_scaled(r for r in mine if r.seed == s and r.decoded_known) for s in seeds]
        met = _met(min(decoded) >= trial.goal) if mine[0].share == 1 else "-"  # a sample is too small
        rows.append(
            (
                f"{trial.figure}/{trial.trial}: {trial.speed_kmh:g} km/h, {trial.fps:g} fps, {trial.depression_deg:g}°"
                + (f", azimuth {trial.azimuth_deg:+g}°" if trial.azimuth_deg else "")
                + (f", {trial.height_m:g} m" if trial.height_m != 1.57 else "")
                + (f", {trial.illumination}" if trial.illumination != "daylight" else ""),
                _round(_scaled(mine) / len(seeds)),
                _round(float(np.mean(decoded))),
                _round(min(decoded)),
                sum(len(r.wrong) for r in mine),
                _round(float(np.mean(known))),
                sum(len(r.wrong_known) for r in mine),
                _round(_scaled(r for r in mine if r.decoded_paper) / len(seeds)),
                sum(len(r.wrong_paper) for r in mine),
                f"{trial.frames_decoded} of {trial.frames_detected}",
                f"{np.mean(decoded) / trial.frames_decoded:.1f}",
                trial.goal,
                met,
            )
        )
    head = (
        "figure/trial",
        "in view",
        "decoded",
        "minimum",
        "wrong",
        "with codebook",
        "wrong",
        "Algorithm 1",
        "wrong",
        "paper",
        "ratio",
        "goal",
        "met",
    )
    return table(head, rows)


def _scaled(records: Iterable[Record]) -> float:
    """Frames of the whole set that some of its frames stand for."""
    return sum(1 / r.share for r in records)


def _round(value: float) -> str:
    return f"{value:.0f}"


def height_table(records: Sequence[Record]) -> str:
    """Decode rate by the plate's height in the image, and of the other sets."""
    rows = []
    for low, high, goal in BINS:
        name = f"trials, {low}-{high} rows" if high < math.inf else f"trials, {low} rows and more"
        rows.append(_rate_row(name, [r for r in records if r.set_name == "trial" and low <= r.height_px < high], goal))
    for name, key, goal in (
        ("stress, 24 rows and more", "stress", 90),
        ("night with LED, 24 rows and more", "night", None),
        *((f"thermal at {speed:.0f} km/h, 16 rows and more", name, 80 if speed == 10 else 60)
          for name, speed in THERMAL_KMH.items()),
        ("partly hidden or out of view", "hidden", None),
    ):  # fmt: skip
        rows.append(_rate_row(name, [r for r in records if r.set_name == key], goal))
    head = ("set", "frames", "decoded", "rate %", "with codebook %", "goal %", "met")
    return table(head, [row for row in rows if row[1]])


def _rate_row(name: str, records: Sequence[Record], goal: int | None) -> tuple[object, ...]:
    if not records:
        return (name, 0, 0, "-", "-", goal or "-", "-")
    decoded = sum(r.decoded for r in records)
    rate = 100 * decoded / len(records)
    known = 100 * sum(r.decoded_known for r in records) / len(records)
    met = "-" if goal is None else _met(rate >= goal)
    return (name, len(records), decoded, f"{rate:.1f}", f"{known:.1f}", goal or "-", met)


def wrong_table(records: Sequence[Record]) -> str:
    """Digits returned as valid that are on no plate: of single frames, of those of a drive together, with codebook."""
    rows = []
    for name, sets in (
        ("trials", ("trial",)), ("stress", ("stress",)), ("night with LED", ("night",)),
        *((name.replace("-", " "), (name,)) for name in LIGHT), ("thermal", tuple(THERMAL_KMH)),
        ("partly hidden or out of view", ("hidden",)), ("all with a plate", WITH_PLATE),
        ("no plate", ("free",)), ("look-alikes", ("look-alikes",)), ("all without a plate", WITHOUT_PLATE),
    ):  # fmt: skip
        mine = [r for r in records if r.set_name in sets and not r.height_px < RENDERED_ROWS]
        if mine:
            wrong = sum(len({*r.wrong, *r.wrong_together}) for r in mine)
            known = sum(len(r.wrong_known) for r in mine)
            rows.append((name, len(mine), wrong, known, 0, _met(wrong + known == 0)))
    return table(("set", "frames", "wrong", "wrong with codebook", "goal", "met"), rows)


def peers_table(records: Sequence[Record]) -> str:
    """Frames decoded beside tags in the same scenes."""
    rows = []
    for name, key in (("trials", "trial"), ("stress", "stress")):
        mine = [r for r in records if r.set_name == key and r.tags is not None]
        if not mine:
            continue
        ours = sum(r.decoded for r in mine)
        for k, family in enumerate(FAMILIES):
            theirs = sum(r.tags[k] for r in mine if r.tags is not None)
            ratio = ours / theirs if theirs else math.inf
            rows.append((name, family.name, len(mine), ours, theirs, f"{ratio:.2f}", 1.5, _met(ratio >= 1.5)))
    return table(("set", "peer", "frames", "plate", "peer's tag", "ratio", "goal", "met"), rows)


def light_table(records: Sequence[Record]) -> str:
    """Frames and drives in one kind of light, or with one kind of damage, beside tags in the same scenes."""
    rows = []
    for name in LIGHT:
        mine = [r for r in records if r.set_name == name]
        if not mine:
            continue
        drives: dict[tuple[int, str], list[Record]] = {}
        for record in mine:
            drives.setdefault((record.seed, record.label), []).append(record)
        lost = [sum(not any(getattr(r, how) for r in drive) for drive in drives.values())
                for how in ("decoded", "together", "decoded_known")]  # fmt: skip
        theirs = [sum(r.tags[k] for r in mine if r.tags is not None) for k in range(len(FAMILIES))]
        tentative = f"{sum(r.tentative for r in mine)} / {sum(len(r.wrong_tentative) for r in mine)}"
        read = [
            f"{sum(getattr(r, how) for r in mine)} / {sum(len(getattr(r, wrong)) for r in mine)}"
            for how, wrong in (("decoded", "wrong"), ("together", "wrong_together"), ("decoded_known", "wrong_known"))
        ]
        rows.append((name, len(mine), read[0], tentative, *read[1:], len(drives), " / ".join(map(str, lost)), *theirs))
    head = ("set", "frames", "sure / wrong", "tentative / wrong", "with the drive's frames / wrong",
            "with codebook / wrong", "drives", "lost alone / with the drive's frames / with codebook",
            *(family.name for family in FAMILIES))  # fmt: skip
    return table(head, rows)


def reliability_table(records: Sequence[Record]) -> str:
    """Reported confidence beside the share that is right, of sure and of tentative readings."""
    rows = []
    for name in (*LIGHT, "stress"):
        claims = [claim for r in records if r.set_name == name for claim in r.claims]
        row: list[object] = [name]
        for wanted in (True, False):
            mine = [(confidence, right) for confidence, sure, right in claims if sure is wanted]
            mean = f"{np.mean([confidence for confidence, _ in mine]):.5f}" if mine else "-"
            row += [len(mine), mean, f"{np.mean([right for _, right in mine]):.4f}" if mine else "-"]
        if claims:
            rows.append(tuple(row))
    head = ("set", "sure", "mean confidence", "share right", "tentative", "mean confidence", "share right")
    return table(head, rows)


def _met(yes: bool) -> str:
    return "yes" if yes else "**no**"


def speed_table(timings: Sequence[Timing]) -> str:
    """Milliseconds of the processor a frame."""
    rows = []
    for t in timings:
        ours = next(o for o in timings if o.what == "decode_plates" and o.frames == t.frames)
        if t.what == "decode_plates":
            goal, met = "5 ms", _met(t.mean_ms <= 5)
        elif t.what == "JPEG bytes to digits":
            goal, met = "15 ms", _met(t.mean_ms <= 15)
        else:
            goal, met = "ratio 4", _met(t.mean_ms >= 4 * ours.mean_ms)
        ratio = f"{t.mean_ms / ours.mean_ms:.1f}"
        rows.append(
            (f"{t.what}, {t.frames}", f"{t.median_ms:.2f}", f"{t.mean_ms:.2f}", f"{t.worst_ms:.1f}", ratio, goal, met)
        )
    return table(
        ("1080p, CPU of one thread", "median ms", "mean ms", "worst ms", "ratio to decode_plates", "goal", "met"), rows
    )


def stages_table(timings: Sequence[StageTiming]) -> str:
    """Mean milliseconds of the processor by stage and group of frames, the longest stage of all first."""
    groups = list(dict.fromkeys(t.frames for t in timings))
    by_stage: dict[str, dict[str, float]] = {}
    for t in timings:
        by_stage.setdefault(t.stage, {})[t.frames] = t.mean_ms
    order = sorted(by_stage, key=lambda stage: -sum(by_stage[stage].values()))
    rows = [(stage, *(f"{by_stage[stage].get(group, 0.0):.2f}" for group in groups)) for stage in order]
    return table(("stage, mean ms", *groups), rows)


def accuracy_table(records: Sequence[Record]) -> str:
    """Errors over the frames decoded in the trials."""
    mine = [r for r in records if r.set_name == "trial" and r.decoded]
    corners = np.array([e for r in mine for e in r.corner_errors_px])
    rows = [_error_row("corners [px]", corners, 3, (0.2, 0.6))]
    for name, rolling, goals in (
        ("camera position, global shutter [mm]", False, (6, 20)),
        ("camera position, rolling shutter of 2-12 ms, not compensated [mm]", True, None),
    ):
        errors = np.array([1000 * r.position_error_m for r in mine if r.rolling is rolling])
        rows.append(_error_row(name, errors[np.isfinite(errors)], 1, goals))
    located = [(r.height_px, r.accuracy, r.rolling) for r in mine if r.accuracy is not None]
    moving = np.array([1000 * found.error_m for _rows, found, rolling in located if rolling])
    rows.append(_error_row("camera position, rolling shutter, compensated with the speed [mm]", moving, 1, (6, 20)))
    errors_table = table(("error", "values", "median", "goal", "95 %", "goal", "met"), rows)
    return f"{errors_table}\n\n{_accuracy_by_rows([(rows_px, found) for rows_px, found, _rolling in located])}"


def _accuracy_by_rows(located: Sequence[tuple[float, PositionAccuracy]]) -> str:
    rows = []
    for low, high in itertools.pairwise((*ACCURACY_ROWS, math.inf)):
        found = [one for rows_px, one in located if low <= rows_px < high]
        if not found:
            continue
        errors, limits = (
            np.array([1000 * getattr(one, name) for one in found]) for name in ("error_m", "noise_error_m")
        )
        median, high_mm = np.percentile(errors, (50, 95))
        within = np.mean([one.within_2_sigma for one in found])
        rows.append(
            (f"{low:g}-{high:g}" if math.isfinite(high) else f"{low:g} and more", len(found), f"{median:.1f}",
             f"{high_mm:.1f}", f"{np.percentile(limits, 95):.1f}", f"{np.mean(errors <= 20):.1%}", f"{within:.1%}")
        )  # fmt: skip
    head = ("rows", "frames", "median mm", "95 % mm", "95 % at the limit", "within 20 mm", "within 2 sigma")
    return table(head, rows)


def _error_row(
    name: str, errors: npt.NDArray[np.float64], places: int, goals: tuple[float, float] | None
) -> tuple[object, ...]:
    median, high = np.percentile(errors, (50, 95)) if errors.size else (math.inf, math.inf)
    met = "-" if goals is None else _met(bool(median <= goals[0] and high <= goals[1]))
    wanted = goals or ("-", "-")
    return (name, errors.size, f"{median:.{places}f}", wanted[0], f"{high:.{places}f}", wanted[1], met)


def frame_list(records: Iterable[Record]) -> str:
    """Frames by the names that ``python -m benchmarks.plates.show`` takes, with the wrong digits if any."""
    return "\n".join(
        f"- {r.set_name} {r.index} {r.number} --seed {r.seed} ({r.label}, {r.height_px:.1f} rows)"
        + (f": {', '.join({*r.wrong, *r.wrong_known})}" if r.wrong or r.wrong_known else "")
        for r in records
    )

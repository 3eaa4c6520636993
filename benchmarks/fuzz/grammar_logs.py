"""Valid logs of vehicles with known content, for `benchmarks.fuzz.grammar`."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from app.formats.logs import LogClock
from app.formats.poses import PoseDeclaration, read_poses
from app.formats.traces.can_log import read_can_log
from app.formats.traces.declaration import CanDeclaration, CanSignal, TraceLimits, TraceReport
from app.formats.traces.parts import open_parts
from benchmarks.fuzz.grammar import Check, Grammar, Rng
from benchmarks.fuzz.grammar_tables import chance, pick

# === CAN logs: candump's log file, Vector's ASC, SavvyCAN's CSV.


def _can(rng: Rng) -> tuple[str, Check]:
    """Speed in 16 bits of one identifier among others, on one of several channels, 11 or 29 bits."""
    is_extended, channel = bool(rng.integers(2)), int(rng.integers(1, 4))
    own = int(rng.integers(0x800, 0x1FFFFFFF) if is_extended else rng.integers(1, 0x7FF))
    start, step = float(rng.integers(10_000, 2_000_000)) + 0.25, float(rng.choice([0.01, 0.02, 0.1]))
    count = int(rng.integers(12, 60))
    kmh = np.round(np.abs(np.cumsum(rng.normal(0, 1.5, count)) + 40), 2)
    frames: list[tuple[float, int, bool, int, bytes]] = []
    for k, value in enumerate(kmh):
        data = round(float(value) * 100).to_bytes(2, "little") + bytes(rng.integers(0, 256, 6, np.uint8))
        at = start + k * step
        frames.append((at, own, is_extended, channel, data))
        if rng.random() < 0.5:  # the same number of the other length, on the same channel
            frames.append((at + step / 5, own & 0x7FF or 1, not is_extended, channel, bytes(8)))
        if rng.random() < 0.5:
            frames.append((at + step / 4, own, is_extended, channel % 3 + 1, bytes([9] * 8)))
        if rng.random() < 0.3 and own != 0x7DF:
            frames.append((at + step / 3, 0x7DF, False, channel, bytes(8)))
    kind = str(rng.choice(["candump", "asc", "asc relative", "savvycan"]))
    text = {
        "candump": _candump, "asc": _asc, "asc relative": lambda f: _asc(f, relative=True), "savvycan": _savvycan,
    }[kind](frames)  # fmt: skip
    name = {"candump": "drive.log", "savvycan": "drive.csv"}.get(kind, "drive.asc")
    signal = CanSignal(arbitration_id=own, start_bit=0, length=16, factor=0.01, unit="km/h", extended=is_extended)
    declared = f"can{channel}" if kind == "candump" else channel

    def check() -> str:
        (part,) = open_parts({name: text.encode()}, TraceLimits())
        declaration = CanDeclaration(speed=signal, offset_s=0.0, channel=declared)
        series = read_can_log(part, [], declaration, TraceLimits(), TraceReport())["speed"]
        if len(series.value) != count:
            return f"{kind}: {len(series.value)} of {count} values"
        if np.abs(series.value - kmh).max() > 1e-9:
            return f"{kind}: other values"
        if np.abs(series.t_s - series.t_s[0] - np.arange(count) * step).max() > 2e-6 * count:
            return f"{kind}: other times"
        return ""

    return text, check


def _candump(frames: list[tuple[float, int, bool, int, bytes]]) -> str:
    """candump -l of can-utils: 3 or 8 digits tell the lengths of identifiers apart."""
    return "".join(
        f"({t:.6f}) can{channel} {number:0{8 if is_extended else 3}X}#{data.hex().upper()}\n"
        for t, number, is_extended, channel, data in frames
    )


def _asc(frames: list[tuple[float, int, bool, int, bytes]], *, relative: bool = False) -> str:
    """Vector's ASC: an x after 29 bits; relative times are those since the line before."""
    base = "relative" if relative else "absolute"
    lines = ["date Mon Jun 1 08:00:00.000 am 2026", f"base hex  timestamps {base}", "internal events logged",
             "Begin Triggerblock Mon Jun 1 08:00:00.000 am 2026"]  # fmt: skip
    zero = frames[0][0] - 0.5
    last = zero
    for t, number, is_extended, channel, data in frames:
        shown = round(t - zero, 6) - round(last - zero, 6) if relative else t - zero
        last = t
        text = f"{number:X}{'x' if is_extended else ''}"
        lines.append(f"   {shown:.6f} {channel}  {text:15} Rx   d {len(data)} " + " ".join(f"{b:02X}" for b in data))
    return "\n".join([*lines, "End TriggerBlock", ""])


def _savvycan(frames: list[tuple[float, int, bool, int, bytes]]) -> str:
    lines = ["Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8"]
    for t, number, is_extended, channel, data in frames:
        cells = ",".join(f"{b:02X}" for b in data)
        lines.append(f"{round(t * 1e6)},{number:08X},{str(is_extended).lower()},Rx,{channel},{len(data)},{cells},")
    return "\n".join([*lines, ""])


# === NMEA 0183: sentences of an epoch in the order of the receiver's choice.

_WEEK_S = 7 * 86_400


@dataclass(frozen=True, slots=True)
class _Epoch:
    """What a receiver knows at one time."""

    at: datetime
    lon_deg: float
    lat_deg: float
    heading_deg: float
    is_void: bool


@dataclass(frozen=True, slots=True)
class _Receiver:
    """How a receiver writes; its sentences come in the same order in all epochs."""

    kinds: list[str]  # the sentences of an epoch in their order
    talkers: list[str]  # several where it sees satellites of one system only at times
    decimals: int  # of times
    speed_kn: float
    is_estimating: bool  # by dead reckoning
    deviations_m: tuple[float, float]  # latitude, longitude
    behind_weeks: int  # its dates, after a rollover of the week counter that it missed

    def sentence(self, kind: str, talker: str, epoch: _Epoch) -> str:
        """One sentence of an epoch."""
        at = epoch.at - timedelta(weeks=self.behind_weeks)
        clock = at.strftime("%H%M%S") + (f".{at.microsecond:06d}"[: 1 + self.decimals] if self.decimals else "")
        place = f"{_degrees(epoch.lat_deg, 'NS', 2)},{_degrees(epoch.lon_deg, 'EW', 3)}"
        mode = "N" if epoch.is_void else "E" if self.is_estimating else "D"
        status = "V" if epoch.is_void else "A"
        heading = f"{epoch.heading_deg:.2f}"
        speed, course = f"{self.speed_kn:.2f}", heading
        if epoch.is_void:
            place, speed, course = ",,,", "", ""
        content = {
            "RMC": f"{clock},{status},{place},{speed},{course},{at:%d%m%y},,,{mode}",
            "GGA": f"{clock},{place},{ {'N': 0, 'E': 6, 'D': 4}[mode] },12,0.8,100.0,M,47.0,M,,",
            "GNS": f"{clock},{place},{mode}{mode},12,0.8,100.0,47.0,,",
            "GLL": f"{place},{clock},{status},{mode}",
            "VTG": f"{course},T,,M,{speed},N,{speed and '37.0'},K,{mode}",
            "GST": f"{clock},1.0,,,,{self.deviations_m[0]:.3f},{self.deviations_m[1]:.3f},1.0",
            "ZDA": f"{clock},{at:%d},{at:%m},{at:%Y},00,00",
            "HDT": f"{heading},T",
            "THS": f"{heading},A",
            "DTM": "W84,,0.0,N,0.0,E,0.0,W84",
            "GSA": "A,3,1,2,3,,,,,,,,,,1.0,0.8,0.6",
        }[kind]
        return _sentence(f"{talker}{kind},{content}")


def _draw_receiver(rng: Rng) -> _Receiver:
    positions = [kind for kind in ("RMC", "GGA", "GNS", "GLL") if chance(rng, 0.4)] or ["RMC"]
    others = [kind for kind in ("VTG", "GST", "ZDA", "DTM", "GSA") if chance(rng, 0.3)]
    heading = str(pick(rng, "HDT", "HDT", "THS", ""))
    kinds = [*positions, *others, *([heading] if heading else [])]
    main = str(pick(rng, "GP", "GN", "GL"))
    return _Receiver(
        [kinds[int(place)] for place in rng.permutation(len(kinds))],
        [main, str(pick(rng, "GP", "GN"))] if chance(rng, 0.3) else [main],
        int(pick(rng, 0, 1, 2, 3)), float(pick(rng, 20.0, 20.0, 0.5)), chance(rng, 0.15),
        (round(float(rng.uniform(0.01, 5)), 3), round(float(rng.uniform(0.01, 5)), 3)),
        int(pick(rng, 0, 0, 0, 1024, 2048)) if {"RMC", "ZDA"} & set(kinds) else 0,
    )  # fmt: skip


def _nmea(rng: Rng) -> tuple[str, Check]:
    """Positions with headings, over midnight or not, with talkers and sentences of different receivers."""
    receiver = _draw_receiver(rng)
    count, rate_s = int(rng.integers(4, 20)), float(pick(rng, 1.0, 0.1, 0.2, 0.05)) if receiver.decimals > 1 else 1.0
    begins = datetime(2026, int(rng.integers(1, 13)), 28, 23, 59, 59, tzinfo=UTC) - timedelta(
        seconds=float(rng.choice([0.0, 1.0, 40_000.0]))
    )
    lon = float(rng.uniform(-179, 179)) + np.cumsum(np.full(count, 4e-6))
    lat = float(rng.uniform(-70, 70)) + np.cumsum(np.full(count, 3e-6))
    heading = (float(rng.uniform(0, 360)) + np.cumsum(rng.uniform(2, 9, count))) % 360
    void = rng.random(count) < float(pick(rng, 0.0, 0.2))
    void[int(rng.integers(count))] = False
    epochs = [
        _Epoch(begins + timedelta(seconds=k * rate_s), lon[k], lat[k], heading[k], bool(void[k])) for k in range(count)
    ]
    lines: list[str] = []
    for epoch in epochs:
        talker = str(pick(rng, *receiver.talkers))
        lines += [receiver.sentence(kind, talker, epoch) for kind in receiver.kinds]
    is_cut = receiver.kinds[0] in ("HDT", "THS", "VTG") and chance(rng, 0.3)  # recording began within an epoch
    text = "\r\n".join([*lines[is_cut:], ""])
    kept = ~void
    # without dates, that of the first position is declared
    is_dated = bool({"RMC", "ZDA"} & set(receiver.kinds))
    declaration = PoseDeclaration(
        clock=LogClock(offset_s=receiver.behind_weeks * _WEEK_S) if receiver.behind_weeks else None,
        date=None if is_dated else epochs[int(np.flatnonzero(kept)[0])].at.date(),
    )
    has_course = bool({"RMC", "VTG"} & set(receiver.kinds)) and receiver.speed_kn > 2
    if not {"HDT", "THS"} & set(receiver.kinds) and not has_course:
        heading = np.full(count, np.nan)
    north_m, east_m = receiver.deviations_m
    accuracy_m = np.hypot(north_m, east_m) if "GST" in receiver.kinds else np.nan  # of both axes, as of a bag
    what = f"{' '.join(receiver.kinds)}, void {np.flatnonzero(void)}, cut {is_cut}"

    def check() -> str:
        track, report = read_poses("a.nmea", text.encode(), declaration)
        if len(track.time_s) != kept.sum() or report.left_out_count != void.sum():
            return f"{len(track.time_s)} of {kept.sum()} positions, {report.left_out_count} left out ({what})"
        wanted = (begins.timestamp() + np.arange(count) * rate_s)[kept]
        if np.abs(track.time_s - wanted).max() > 1e-5:
            return f"times off by {np.abs(track.time_s - wanted).max():.5f} s ({what})"
        if max(np.abs(track.lon_deg - lon[kept]).max(), np.abs(track.lat_deg - lat[kept]).max()) > 1e-8:
            return f"other positions ({what})"
        if not np.allclose(track.accuracy_m, accuracy_m, equal_nan=True):
            return f"accuracies {track.accuracy_m}, not {accuracy_m} ({what})"
        if receiver.is_estimating is not any("dead reckoning" in warning for warning in report.warnings):
            return f"warnings {report.warnings} ({what})"
        off = np.abs((track.heading_deg - heading[kept] + 180) % 360 - 180)
        if is_cut or any("have no time" in warning for warning in report.warnings):
            # one epoch early or late; a cut log that turns by less than 5 deg from one to the next needs no warning
            return ""
        if not np.array_equal(np.isnan(track.heading_deg), np.isnan(heading[kept])):
            return f"headings {track.heading_deg} ({what})"
        if np.nanmax(off, initial=0.0) > 0.02:
            return f"headings off by {np.nanmax(off):.1f} deg, without a warning ({what})"
        return ""

    return text, check


def _degrees(value: float, signs: str, width: int) -> str:
    whole, minutes = divmod(abs(value) * 60, 60)
    return f"{int(whole):0{width}d}{minutes:010.7f},{signs[int(value < 0)]}"


def _sentence(content: str) -> str:
    checksum = 0
    for byte in content.encode():
        checksum ^= byte
    return f"${content}*{checksum:02X}"


LOG_GRAMMARS: dict[str, Grammar] = {"can": _can, "nmea": _nmea}

"""Valid logs of vehicles with known content, for `benchmarks.fuzz.grammar`."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np

from app.formats.poses import PoseDeclaration, read_poses
from app.formats.traces.can_log import read_can_log
from app.formats.traces.declaration import CanDeclaration, CanSignal, TraceLimits, TraceReport
from app.formats.traces.parts import open_parts
from benchmarks.fuzz.grammar import Check, Grammar, Rng

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


def _nmea(rng: Rng) -> tuple[str, Check]:
    """Positions with headings, over midnight or not, with talkers and sentences of different receivers."""
    count, rate_s = int(rng.integers(4, 20)), float(rng.choice([0.1, 0.2, 1.0]))
    begins = datetime(2026, int(rng.integers(1, 13)), 28, 23, 59, 59, tzinfo=UTC) - timedelta(
        seconds=float(rng.choice([0.0, 1.0, 40_000.0]))
    )
    lon = float(rng.uniform(-179, 179)) + np.cumsum(np.full(count, 4e-6))
    lat = float(rng.uniform(-70, 70)) + np.cumsum(np.full(count, 3e-6))
    heading = (float(rng.uniform(0, 360)) + np.cumsum(rng.uniform(2, 9, count))) % 360
    talker, fixes = str(rng.choice(["GP", "GN", "GL"])), str(rng.choice(["RMC", "GGA+ZDA", "RMC+GGA"]))
    order = rng.permutation(3)
    lines: list[str] = []
    for k in range(count):
        at = begins + timedelta(seconds=k * rate_s)
        clock = at.strftime("%H%M%S") + f".{at.microsecond // 10_000:02d}"
        place = f"{_degrees(lat[k], 'NS', 2)},{_degrees(lon[k], 'EW', 3)}"
        epoch = [
            f"{talker}RMC,{clock},A,{place},20.0,{heading[k]:.2f},{at:%d%m%y},,,A" if "RMC" in fixes else "",
            f"{talker}GGA,{clock},{place},4,12,0.8,100.0,M,47.0,M,," if "GGA" in fixes else "",
            f"{talker}HDT,{heading[k]:.2f},T",
        ]
        if fixes == "GGA+ZDA":
            epoch[0] = f"{talker}ZDA,{clock},{at:%d},{at:%m},{at:%Y},00,00"
        lines += [_sentence(epoch[place]) for place in order if epoch[place]]
    text = "\r\n".join([*lines, ""])

    def check() -> str:
        track, report = read_poses("a.nmea", text.encode(), PoseDeclaration())
        if len(track.time_s) != count:
            return f"{len(track.time_s)} of {count} positions ({fixes}, order {order})"
        wanted = begins.timestamp() + np.arange(count) * rate_s
        if np.abs(track.time_s - wanted).max() > 0.011:
            return f"times off by {np.abs(track.time_s - wanted).max():.2f} s ({fixes}, order {order})"
        if max(np.abs(track.lon_deg - lon).max(), np.abs(track.lat_deg - lat).max()) > 2e-7:
            return "other positions"
        off = np.abs((track.heading_deg - heading + 180) % 360 - 180)
        if not np.nanmax(off, initial=0.0) < 0.02 and not report.warnings:
            return f"headings off by {np.nanmax(off):.1f} deg, without a warning ({fixes}, order {order})"
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

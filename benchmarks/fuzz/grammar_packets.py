"""Valid packet logs with known content: tables, JSON, and the uplinks of network servers.

Field by field after the pages that `app.formats.packets.json` names. Servers that write proto3 JSON leave out what is
zero, false or empty.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Any

from app.formats.logs import LogClock
from app.formats.packets.read import read_packets
from app.formats.packets.rows import PacketDeclaration
from app.markers.cerpm import LaneSide
from benchmarks.fuzz.grammar import Check, Grammar, Rng
from benchmarks.fuzz.grammar_tables import (
    Instant,
    TableForm,
    TimeForm,
    calendar_text,
    chance,
    draw_name,
    draw_table_form,
    draw_time_form,
    instants,
    pick,
    zone_text,
)

Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class _Packet:
    """What a log states of a packet; NaN and None where it states nothing."""

    at: Instant
    payload: bytes
    rssi_dbm: float
    snr_db: float
    has_time: bool = True
    device: str | None = None
    # a packet in clear: number, longitude, latitude [deg], height [m], side
    claim: tuple[int, float, float, float | None, LaneSide] | None = None


@dataclass(frozen=True, slots=True)
class _Log:
    """A log with what it holds."""

    content: bytes
    packets: list[_Packet]
    declaration: PacketDeclaration
    left_out: int = 0  # entries that are no packets
    is_zoned: bool = True


def _packets(rng: Rng) -> tuple[bytes, Check]:
    """One kind of log with a few packets."""
    begins = datetime(2012, 9, 1, 12, tzinfo=UTC) + timedelta(milliseconds=int(rng.integers(0, 500_000_000_000)))
    step_us = int(pick(rng, 100_000, 1_000_000, 7_250_000, 60_000_000))
    times = instants(begins, [k * step_us for k in range(int(rng.integers(1, 9)))])
    packets = [
        _Packet(
            at, bytes([0x10 | int(rng.integers(16))]) + rng.bytes(23), float(rng.integers(-1390, -200)) / 10,
            float(rng.integers(-80, 56)) / 4, device=rng.bytes(8).hex().upper(),
        )
        for at in times
    ]  # fmt: skip
    kind = str(pick(rng, "table", "objects", *_SERVERS))
    if kind == "table":
        log = _table(rng, packets)
    elif kind == "objects":
        log = _objects(rng, packets)
    else:
        log = _uplinks(rng, packets, _SERVERS[kind])
    return log.content, lambda: _difference(kind, log)


def _difference(kind: str, log: _Log) -> str:
    found = read_packets("upload", log.content, log.declaration)
    if len(found.packets) != len(log.packets) or found.report.left_out_count != log.left_out:
        return f"{kind}: {len(found.packets)} of {len(log.packets)} packets, left out {found.report.left_out[:2]}"
    for number, (read, wanted) in enumerate(zip(found.packets, log.packets, strict=True)):
        where = f"{kind}, packet {number}"
        offset_s = (log.declaration.clock or LogClock()).offset_s
        if math.isnan(read.received_at_s) is wanted.has_time:
            return f"{where}: a time is {read.received_at_s} ({found.report.warnings})"
        if wanted.has_time and abs(read.received_at_s - wanted.at.seconds) > 2e-6 + abs(offset_s) * 1e-12:
            return f"{where}: time off by {read.received_at_s - wanted.at.seconds:.6f} s"
        if wanted.claim is None and read.payload != wanted.payload:
            return f"{where}: another payload"
        if wanted.claim is not None:
            claim = read.claim
            if (
                claim is None
                or (claim.number, claim.lon_deg, claim.lat_deg, claim.height_m, claim.side) != wanted.claim
            ):
                return f"{where}: {claim} instead of {wanted.claim}"
        if not _same(read.rssi_dbm, wanted.rssi_dbm) or not _same(read.snr_db, wanted.snr_db):
            return f"{where}: {read.rssi_dbm} dBm, {read.snr_db} dB, not {wanted.rssi_dbm} dBm, {wanted.snr_db} dB"
        if read.device != wanted.device:
            return f"{where}: device {read.device} instead of {wanted.device}"
    untimed = any(not packet.has_time for packet in log.packets)
    if untimed and not any("have no time" in warning for warning in found.report.warnings):
        return f"{kind}: packets without times, without a warning"
    assumed = any("without a zone" in warning for warning in found.report.warnings)
    if assumed is log.is_zoned:
        return f"{kind}: {'a' if assumed else 'no'} warning that times have no zone"
    return ""


def _same(a: float, b: float) -> bool:
    return (math.isnan(a) and math.isnan(b)) or abs(a - b) < 1e-9


# === Tables and plain objects.


def _payload_text(rng: Rng, payload: bytes, form: str) -> str:
    return {
        "hex": payload.hex(), "HEX": payload.hex().upper(), "0x": "0x" + payload.hex(), "spaced": payload.hex(" "),
        "base64": base64.b64encode(payload).decode(), "url": base64.urlsafe_b64encode(payload).decode().rstrip("="),
    }[form]  # fmt: skip


def _columns(
    rng: Rng, packets: list[_Packet], number: Callable[[float, int], str]
) -> tuple[list[_Packet], dict[str, list[str]], TimeForm]:
    """What is stated of packets, as names of quantities and texts; some quantities are missing, some cells empty."""
    has = {name: chance(rng, 0.8) for name in ("rssi", "snr", "time", "device")}
    times = draw_time_form(rng, 6 if chance(rng) else 3, point=number(0.5, 1)[1])
    if chance(rng):  # packets in clear
        packets = [
            replace(
                packet,
                claim=(
                    int(rng.integers(1, 1_000_000)), round(float(rng.uniform(-179, 179)), 7),
                    round(float(rng.uniform(-70, 70)), 7),
                    round(float(rng.uniform(-50, 900)), 2) if chance(rng) else None,
                    LaneSide(int(rng.integers(3))),
                ),
            )
            for packet in packets
        ]  # fmt: skip
    stated: list[_Packet] = []
    columns: dict[str, list[str]] = {name: [] for name, there in has.items() if there}
    for packet in packets:
        empty = {name: chance(rng, 0.1) for name in has}
        cells = {
            "rssi": number(packet.rssi_dbm, 1), "snr": number(packet.snr_db, 2), "time": times.write(packet.at),
            "device": str(packet.device),
        }  # fmt: skip
        for name in has:
            if has[name]:
                columns[name].append("" if empty[name] else cells[name])
        missing = {name: empty[name] or not has[name] for name in has}
        stated.append(
            replace(
                packet,
                rssi_dbm=math.nan if missing["rssi"] else packet.rssi_dbm,
                snr_db=math.nan if missing["snr"] else packet.snr_db,
                has_time=not missing["time"],
                device=None if missing["device"] else packet.device,
            )
        )
    if packets[0].claim is None:
        form = str(pick(rng, "hex", "HEX", "0x", "spaced", "base64", "url"))
        columns["payload"] = [_payload_text(rng, packet.payload, form) for packet in packets]
    else:
        sides = str(pick(rng, "left right", "L R", "1 2")).split()
        for packet in packets:
            assert packet.claim is not None
            marker, lon_deg, lat_deg, height_m, side = packet.claim
            written = {LaneSide.LEFT: sides[0], LaneSide.RIGHT: sides[1]}.get(side, "")
            for name, text in (
                ("number", str(marker)), ("lon", number(lon_deg, 7)), ("lat", number(lat_deg, 7)),
                ("height", "" if height_m is None else number(height_m, 2)), ("side", written),
            ):  # fmt: skip
                columns.setdefault(name, []).append(text)
    return stated, columns, times


_NAMES = {
    "rssi": ("rssi", "rssi_dbm"), "snr": ("snr", "snr_db", "lsnr"), "device": ("dev_eui", "device_id", "device"),
    "time": ("timestamp", "time", "received_at", "datetime"), "payload": ("payload", "data", "frm_payload", "raw"),
    "number": ("id", "marker_id", "number"), "lon": ("longitude", "lon", "lng", "lon_deg"),
    "lat": ("latitude", "lat", "lat_deg"), "height": ("altitude", "height", "alt_m"), "side": ("side", "lane_side"),
}  # fmt: skip


def _table(rng: Rng, packets: list[_Packet]) -> _Log:
    """CSV: columns in any order beside others, some of them empty."""
    form: TableForm = draw_table_form(rng)
    stated, columns, times = _columns(rng, packets, form.number)
    named = [(draw_name(rng, *_NAMES[name]), cells) for name, cells in columns.items()]
    for name, cell in (
        ("battery", "3.7"),
        ("comment", ""),
        ("spreading", "SF10BW125"),
        ("note", f"a{form.delimiter} b"),
    ):
        if chance(rng, 0.3):
            named.append((name, [cell] * len(packets)))
    named = [named[int(place)] for place in rng.permutation(len(named))]
    rows = [[cells[number] for _name, cells in named] for number in range(len(packets))]
    content = form.write([name for name, _cells in named], rows)
    return _Log(content, stated, PacketDeclaration(clock=times.clock), is_zoned=_is_zoned(times, columns))


def _is_zoned(times: TimeForm, columns: dict[str, list[str]]) -> bool:
    return (
        times.names_zone
        or (times.clock is not None and bool(times.clock.utc_offset_s))
        or not any(columns.get("time", ()))
    )


def _objects(rng: Rng, packets: list[_Packet]) -> _Log:
    """JSON with the same names; numbers as numbers or as text."""
    stated, columns, times = _columns(rng, packets, lambda value, decimals: f"{value:.{decimals}f}")
    names = {name: str(pick(rng, *_NAMES[name])) for name in columns}
    as_text = chance(rng, 0.2)
    records: list[Json] = []
    for number in range(len(packets)):
        record: Json = {}
        for name in columns:
            text = columns[name][number]
            is_number = name in ("rssi", "snr", "number", "lon", "lat", "height") or (
                name == "time" and times.is_number
            )
            if text == "":
                if chance(rng):
                    record[names[name]] = None
                continue
            record[names[name]] = json.loads(text) if is_number and not as_text else text
        if chance(rng, 0.3):
            record["battery"] = {"volts": 3.7}
        records.append(record)
    declaration = PacketDeclaration(clock=times.clock)
    return _Log(_container(rng, records), stated, declaration, is_zoned=_is_zoned(times, columns))


def _container(rng: Rng, records: list[Json]) -> bytes:
    """Records as lines, an array, a document, documents one after the other, or in envelopes."""
    kind = str(pick(rng, "lines", "array", "document", "concatenated", "pretty", "sequence", "topics", "envelopes"))
    compact = (",", ":") if chance(rng) else (", ", ": ")
    if kind == "envelopes":
        as_text = chance(rng)
        records = [{"topic": "road/up", "payload": json.dumps(record) if as_text else record} for record in records]
    dumped = [json.dumps(record, separators=compact, ensure_ascii=chance(rng)) for record in records]
    end = str(pick(rng, "\n", "\r\n"))
    if kind == "array":
        text = json.dumps(records, indent=2) if chance(rng) else "[" + ",".join(dumped) + "]"
    elif kind == "document":
        name = str(pick(rng, "packets", "uplinks", "events"))
        text = json.dumps({"from": "gateway", name: records}, indent=pick(rng, None, 1))
    elif kind == "concatenated":
        text = "".join(dumped)
    elif kind == "pretty":
        text = end.join(json.dumps(record, indent=2) for record in records)
    elif kind == "sequence":  # RFC 7464
        text = "".join(f"\x1e{line}\n" for line in dumped)
    elif kind == "topics":  # mosquitto_sub -v
        text = end.join(f"application/1/device/up {line}" for line in dumped)
    else:
        text = end.join(dumped)
    return (text + (end if chance(rng) else "")).encode(str(pick(rng, "utf-8", "utf-8", "utf-8-sig")))


# === Uplinks of network servers. Several gateways receive one: time of the server, RSSI and SNR of the best gateway.


@dataclass(frozen=True, slots=True)
class _Gateway:
    """A reception by a gateway."""

    rssi_dbm: float
    snr_db: float
    at: Instant


_Server = Callable[[Rng, _Packet, list[_Gateway]], tuple[Json, _Packet]]
"""Writes an uplink; the first gateway is the best one. With what the uplink states."""
_SF = ("SF7BW125", "SF9BW125", "SF10BW500", "SF12BW125")


def _uplinks(rng: Rng, packets: list[_Packet], server: tuple[_Server, list[Json]]) -> _Log:
    """Uplinks of one server, and its other events between them."""
    write, others = server
    records: list[Json] = []
    stated: list[_Packet] = []
    left_out = 0
    for packet in packets:
        while others and chance(rng, 0.15):
            records.append(pick(rng, *others))
            left_out += 1
        heard = [_Gateway(packet.rssi_dbm, packet.snr_db, _later(packet.at, -400_000))]
        for _ in range(int(rng.integers(0, 4))):
            weaker_db = float(rng.integers(1, 400)) / 10
            snr_db = float(rng.integers(-80, 56)) / 4
            heard.append(
                _Gateway(
                    round(packet.rssi_dbm - weaker_db, 1), snr_db, _later(packet.at, int(rng.integers(-900_000, 0)))
                )
            )
        record, as_stated = write(rng, packet, heard)
        records.append(record)
        stated.append(as_stated)
    return _Log(_container(rng, records), stated, PacketDeclaration(), left_out)


def _later(at: Instant, us: int) -> Instant:
    return Instant(at.utc_us + us, gps_us=at.gps_us + us)


def _shuffled(rng: Rng, items: list[Json]) -> list[Json]:
    return [items[int(place)] for place in rng.permutation(len(items))]


def _utc(rng: Rng, at: Instant, zone: str | None = None) -> str:
    digits = int(pick(rng, 6, 9))
    shift_s = int(pick(rng, 0, 0, 7200, -16_200)) if zone is None else 0
    text = zone or (zone_text(shift_s) if shift_s else "Z")
    return calendar_text(at, "%Y-%m-%dT%H:%M:%S", digits, shift_s) + text


def _base64(packet: _Packet) -> str:
    return base64.b64encode(packet.payload).decode()


def _without_zeros(record: Json, *names: str) -> Json:
    """As proto3 JSON has it."""
    return {name: value for name, value in record.items() if name not in names or value}


def _things_stack(rng: Rng, packet: _Packet, heard: list[_Gateway]) -> tuple[Json, _Packet]:
    """The Things Stack v3. `channel_rssi` is that of the channel; a packet broker may leave out `rssi`."""
    snr_known = not chance(rng, 0.1)  # an SNR of zero is left out
    metadata: list[Json] = []
    for number, gateway in enumerate(heard):
        snr_db = gateway.snr_db if snr_known or number else 0.0
        one: Json = {
            "gateway_ids": {"gateway_id": f"g{number}", "eui": "B827EBFFFE8B01DD"}, "timestamp": 2463457000,
            "rssi": gateway.rssi_dbm, "channel_rssi": gateway.rssi_dbm, "snr": snr_db,
            "uplink_token": "Ch4KHA==", "channel_index": 2,
        }  # fmt: skip
        if chance(rng, 0.6):
            one["time"] = _utc(rng, gateway.at, "Z")
        if chance(rng, 0.2):
            del one["rssi"]
        elif chance(rng, 0.2):
            del one["channel_rssi"]
        metadata.append(_without_zeros(one, "snr"))
    record: Json = {
        "end_device_ids": {
            "device_id": "cerpm-7", "application_ids": {"application_id": "road"}, "dev_eui": packet.device,
            "dev_addr": "260BABCD",
        },
        "correlation_ids": ["as:up:01"],
        "received_at": _utc(rng, _later(packet.at, 250_000), "Z"),
        "uplink_message": {
            "session_key_id": "AXA50t", "f_port": 1, "f_cnt": 7, "frm_payload": _base64(packet),
            "decoded_payload": {"rssi": -1, "time": "2001-01-01T00:00:00Z"},
            "rx_metadata": _shuffled(rng, metadata),
            "settings": {
                "data_rate": {"lora": {"bandwidth": 125000, "spreading_factor": int(rng.integers(7, 13))}},
                "coding_rate": "4/5", "frequency": "868300000", "timestamp": 2463457000,
            },
            "received_at": _utc(rng, packet.at, "Z"), "consumed_airtime": "0.056576s",
        },
    }  # fmt: skip
    at = packet.at
    if chance(rng, 0.2):
        del record["uplink_message"]["received_at"]
        at = _later(packet.at, 250_000)
    if chance(rng, 0.2):
        record = {"name": "as.up.data.forward", "time": "2001-01-01T00:00:00Z", "data": record}
    elif chance(rng, 0.2):
        record = {"result": record}
    return record, replace(packet, at=at, snr_db=packet.snr_db if snr_known else 0.0)


def _things_network(rng: Rng, packet: _Packet, heard: list[_Gateway]) -> tuple[Json, _Packet]:
    gateways = [
        {
            "gtw_id": f"eui-{number}", "timestamp": 12345, "time": _utc(rng, gateway.at, "Z") if chance(rng) else "",
            "channel": 0, "rssi": gateway.rssi_dbm, "snr": gateway.snr_db, "rf_chain": 0, "latitude": 52.37,
        }
        for number, gateway in enumerate(heard)
    ]  # fmt: skip
    record = {
        "app_id": "road", "dev_id": "cerpm-7", "hardware_serial": packet.device, "port": 1, "counter": 2,
        "payload_raw": _base64(packet), "payload_fields": {"rssi": 1},
        "metadata": {
            "time": _utc(rng, packet.at, "Z"), "frequency": 868.1, "modulation": "LORA",
            "data_rate": str(pick(rng, *_SF)),
            "airtime": 46336000, "coding_rate": "4/5", "gateways": _shuffled(rng, gateways),
        },
    }  # fmt: skip
    return record, packet


def _chirpstack(rng: Rng, packet: _Packet, heard: list[_Gateway]) -> tuple[Json, _Packet]:
    """ChirpStack v4: `time` of the event, or else that of the best gateway, by its clock, the server's or GPS."""
    snr_known = not chance(rng, 0.1)
    source = str(pick(rng, "time", "time", "time", "gwTime", "nsTime", "gps"))
    receptions: list[Json] = []
    for number, gateway in enumerate(heard):
        one: Json = {
            "gatewayId": f"0016c001f153a14{number}", "uplinkId": 4217106255, "rssi": gateway.rssi_dbm,
            "snr": gateway.snr_db if snr_known or number else 0.0, "channel": 3, "location": {"latitude": 42.28},
            "context": "E3OWOQ==", "crcStatus": "CRC_OK",
        }  # fmt: skip
        if source in ("time", "gwTime") and chance(rng, 0.8 if source == "time" else 1.0):
            one["gwTime"] = _utc(rng, gateway.at, "+00:00")
        if source in ("gwTime", "nsTime"):
            shift_us = 0 if source == "nsTime" else 70_000
            one["nsTime"] = _utc(rng, _later(gateway.at, shift_us), "+00:00")
        if source == "gps":
            one["timeSinceGpsEpoch"] = f"{gateway.at.gps_us // 10**6}.{gateway.at.gps_us % 10**6:06d}s"
        receptions.append(_without_zeros(one, "snr"))
    record: Json = {
        "deduplicationId": "3ac7e3c4-4401-4b8d-9386-a5c902f9202d", "time": _utc(rng, packet.at),
        "deviceInfo": {"tenantName": "road", "applicationName": "cerpm", "deviceName": "7", "devEui": packet.device},
        "devAddr": "00189440", "adr": True, "dr": int(rng.integers(1, 6)), "fCnt": 4, "fPort": 1, "confirmed": False,
        "data": _base64(packet), "object": {"rssi": 3.0}, "rxInfo": _shuffled(rng, receptions),
        "txInfo": {
            "frequency": 868500000,
            "modulation": {"lora": {"bandwidth": 125000, "spreadingFactor": 7, "codeRate": "CR_4_5"}},
        },
    }  # fmt: skip
    if source != "time":
        del record["time"]
    at = packet.at if source == "time" else heard[0].at
    return record, replace(packet, at=at, snr_db=packet.snr_db if snr_known else 0.0)


def _helium(rng: Rng, packet: _Packet, heard: list[_Gateway]) -> tuple[Json, _Packet]:
    """Helium's console; times in milliseconds."""
    hotspots = [
        {
            "channel": 12, "frequency": 904.7, "hold_time": 0, "name": f"gruff-pink-{number}", "lat": 37.2,
            "reported_at": gateway.at.utc_us // 1000, "rssi": gateway.rssi_dbm, "snr": gateway.snr_db,
            "spreading": str(pick(rng, *_SF)), "status": "success",
        }
        for number, gateway in enumerate(heard)
    ]  # fmt: skip
    record = {
        "app_eui": "6081F9BF908E2EA0", "dc": {"balance": 2000, "nonce": 1}, "dev_eui": packet.device,
        "devaddr": "9C000148", "fcnt": 2, "hotspots": _shuffled(rng, hotspots), "id": "e1", "name": "cerpm-7",
        "payload": _base64(packet), "payload_size": 24, "port": 2, "raw_packet": "QEgAAJwAAgA=",
        "reported_at": packet.at.utc_us // 1000, "type": "uplink", "uuid": "2d7d3a6f-e5a5-4d0e-b0d1-d1bd0d70a7f1",
    }  # fmt: skip
    return record, replace(packet, at=Instant(packet.at.utc_us // 1000 * 1000))


def _loriot(rng: Rng, packet: _Packet, heard: list[_Gateway]) -> tuple[Json, _Packet]:
    """Loriot: `rx` has one RSSI, `gw` those of its gateways."""
    record: Json = {
        "cmd": "gw", "seqno": 12, "EUI": packet.device, "ts": packet.at.utc_us // 1000, "fcnt": 1, "port": 1,
        "freq": 868100000, "toa": 61, "dr": str(pick(rng, "SF7 BW125 4/5", "SF12 BW500 4/5")), "ack": False, "bat": 255,
        "data": packet.payload.hex() if chance(rng) else packet.payload.hex().upper(),
    }  # fmt: skip
    gateways: list[Json] = [
        {
            "rssi": gateway.rssi_dbm, "snr": gateway.snr_db, "ts": gateway.at.utc_us // 1000, "gweui": f"00-{number}",
            "time": _utc(rng, gateway.at, "Z"), "lat": 47.3, "lon": 8.5,
        }
        for number, gateway in enumerate(heard)
    ]  # fmt: skip
    if chance(rng):
        record |= {"gws": _shuffled(rng, gateways)}
    else:
        record |= {"cmd": "rx", "rssi": packet.rssi_dbm, "snr": packet.snr_db, "offline": False}
    return record, replace(packet, at=Instant(packet.at.utc_us // 1000 * 1000))


def _aws(rng: Rng, packet: _Packet, heard: list[_Gateway]) -> tuple[Json, _Packet]:
    """AWS IoT Core for LoRaWAN; times in whole seconds."""
    gateways = [
        {"GatewayEui": f"80029cfffe5cf1c{number}", "Rssi": gateway.rssi_dbm, "Snr": gateway.snr_db}
        for number, gateway in enumerate(heard)
    ]
    record = {
        "MessageId": "8ab2", "WirelessDeviceId": "5b58", "PayloadData": _base64(packet),
        "WirelessMetadata": {
            "LoRaWAN": {
                "ADR": False, "Bandwidth": 125, "CodeRate": "4/5", "DataRate": str(int(rng.integers(0, 6))),
                "DevAddr": "00b96cd4", "DevEui": packet.device, "FCnt": 1, "FOptLen": 0, "FPort": 2,
                "Frequency": "868100000", "Gateways": _shuffled(rng, gateways), "MType": "UnconfirmedDataUp",
                "SpreadingFactor": 9, "Timestamp": calendar_text(packet.at, "%Y-%m-%dT%H:%M:%SZ"),
            }
        },
    }  # fmt: skip
    return record, replace(packet, at=Instant(packet.at.utc_us // 1_000_000 * 1_000_000))


def _actility(rng: Rng, packet: _Packet, heard: list[_Gateway]) -> tuple[Json, _Packet]:
    """Actility ThingPark: figures as text or as numbers; `LrrRSSI` is that of the best gateway."""

    def written(value: float) -> object:
        return f"{value:.6f}" if as_text else value

    as_text, zone_s = chance(rng), int(pick(rng, 0, 3600, 7200, -14_400))
    gateways = [
        {
            "Lrrid": f"08040{number}",
            "Chain": "0",
            "LrrRSSI": written(gateway.rssi_dbm),
            "LrrSNR": written(gateway.snr_db),
        }
        for number, gateway in enumerate(heard)
    ]
    record = {
        "DevEUI_uplink": {
            "Time": calendar_text(packet.at, "%Y-%m-%dT%H:%M:%S", 3, zone_s) + zone_text(zone_s),
            "DevEUI": packet.device,
            "FPort": "2", "FCntUp": "7", "ADRbit": "1", "MType": "2", "payload_hex": packet.payload.hex(),
            "mic_hex": "38e7a3b9", "Lrcid": "00000065", "LrrRSSI": written(packet.rssi_dbm),
            "LrrSNR": written(packet.snr_db), "SpFact": str(int(rng.integers(7, 13))), "SubBand": "G1",
            "DevLrrCnt": str(len(heard)), "Lrrs": {"Lrr": _shuffled(rng, gateways)}, "CustomerID": "100000507",
        }
    }  # fmt: skip
    return record, replace(packet, at=Instant(packet.at.utc_us // 1000 * 1000))


def _semtech(rng: Rng, packet: _Packet, heard: list[_Gateway]) -> tuple[Json, _Packet]:
    """A packet of a gateway's own program: UTC, or GPS time in milliseconds, or only a counter of microseconds."""
    gateway = heard[0]
    clock = str(pick(rng, "utc", "utc", "gps", "both", "none"))
    one: Json = {
        "tmst": 3512348611, "chan": 2, "rfch": 0, "freq": 866.349812, "stat": int(pick(rng, 1, 1, 0)), "modu": "LORA",
        "datr": str(pick(rng, *_SF)), "codr": "4/6", "rssi": gateway.rssi_dbm, "lsnr": gateway.snr_db, "size": 24,
        "data": _base64(packet),
    }  # fmt: skip
    if clock in ("utc", "both"):
        one["time"] = calendar_text(gateway.at, "%Y-%m-%dT%H:%M:%S", 6) + "Z"
    if clock in ("gps", "both"):
        one["tmms"] = gateway.at.gps_us // 1000
    at = Instant(gateway.at.utc_us // 1000 * 1000) if clock == "gps" else gateway.at
    record: Json = {"rxpk": [one]}
    if chance(rng, 0.3):
        record["stat"] = {"time": "2014-01-12 08:59:28 GMT", "rxnb": 2, "rxok": 2}
    return record, replace(packet, at=at, device=None, has_time=clock != "none")


_JOIN_THINGS_STACK = {
    "end_device_ids": {"device_id": "7"}, "received_at": "2020-01-01T00:00:00Z", "join_accept": {"session_key_id": "A"},
}  # fmt: skip
_OLD_CHIRPSTACK = {
    "applicationID": "123", "applicationName": "cerpm", "deviceName": "7", "devEUI": "0202020202020202",
    "rxInfo": [{"gatewayID": "0303030303030303", "time": "2019-11-08T13:59:25.048445Z", "rssi": -48, "loRaSNR": 9}],
    "txInfo": {"frequency": 868100000, "dr": 5}, "adr": False, "fCnt": 10, "fPort": 5, "data": "EQ==",
}  # fmt: skip
"""ChirpStack v3: docs/cerpms.md lists v4 only, so these are left out by name."""
_SERVERS: dict[str, tuple[_Server, list[Json]]] = {
    "things stack": (_things_stack, [_JOIN_THINGS_STACK]),
    "things network": (_things_network, []),
    "chirpstack": (
        _chirpstack,
        [_OLD_CHIRPSTACK, {"deduplicationId": "1", "deviceInfo": {"devEui": "1"}, "margin": 7}],
    ),
    "helium": (_helium, [{"type": "join", "hotspots": [], "dev_eui": "01"}]),
    "loriot": (_loriot, [{"cmd": "txd", "EUI": "01", "seqdn": 3, "seqq": 3}]),
    "aws": (_aws, []),
    "actility": (_actility, [{"DevEUI_downlink_Sent": {"Time": "2016-01-11T14:28:00.333+02:00", "DevEUI": "01"}}]),
    "semtech": (_semtech, [{"stat": {"time": "2014-01-12 08:59:28 GMT", "rxnb": 2, "rxok": 2}}]),
}

PACKET_GRAMMARS: dict[str, Grammar] = {"packet-logs": _packets}

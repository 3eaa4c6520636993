"""Packet logs as JSON: entries of documents, arrays and lines, and uplinks of LoRaWAN network servers."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from enum import StrEnum
from itertools import islice
from typing import Any

from app.errors import UploadTooLarge
from app.formats.logs import LogClock, TimeScale, utc_from_gps_s
from app.formats.packets.rows import (
    ALIASES,
    NEEDED,
    BrokenEntry,
    PacketSource,
    PayloadText,
    packet_from_values,
    payload_text,
    read_payload,
)
from app.formats.text import MAX_LINE, clean_text, match_columns, numbered_lines, read_number
from app.sensors.pose_track import ReceivedPacket

# === Entries of packet logs in JSON: a document, an array, lines, or documents one after the other.
#
# Every character is parsed at most three times whatever the file holds, so that no file takes longer than its length.


Record = tuple[int, "dict[str, object] | BrokenEntry"]

_LISTS = ("packets", "uplinks", "events", "records", "messages", "results")
_MAX_DEPTH = 32  # levels of nesting
_SPACE = " \t\r\n,\x1e\ufeff"


def read_records(name: str, text: str, document_chars: int) -> Iterator[Record]:
    """Objects with the numbers of their entries; an entry that is no object is a `BrokenEntry`.

    Raises
    ------
    UploadTooLarge
        One document, rather than lines, of more characters than the limit.
    """
    text = text.lstrip(_SPACE)
    first = text.split("\n", 1)[0].rstrip()
    if text[:1] in ("{", "[") and not isinstance(_parse(first[:MAX_LINE]), dict):
        # no object in the first line: one document over many lines, several of them, or broken lines
        if len(text) <= document_chars:
            whole = _parse(text)
            if not isinstance(whole, BrokenEntry):
                return _from_document(whole)
            several = list(_read_concatenated(text))
            if several and isinstance(several[0][1], dict):
                return iter(several)
        elif first in ("[", "{"):
            raise UploadTooLarge(
                f"{name} is one JSON document of {len(text)} characters",
                field="file",
                limit=f"{document_chars} characters in one document",
                cure="write one JSON object a line",
            )
    elif "\n" not in text.rstrip() and text[:1] in ("{", "["):
        return _from_document(_parse(text))
    return _read_lines(text)


def _from_document(document: object) -> Iterator[Record]:
    if isinstance(document, dict):
        within = next((document[n] for n in _LISTS if isinstance(document.get(n), list)), None)
        document = [document] if within is None else within
    for entry, item in enumerate(document if isinstance(document, list) else [document]):
        yield entry, _checked(item)


def _read_lines(text: str) -> Iterator[Record]:
    entry = -1
    for _number, line in numbered_lines(text):
        at = line.find("{", 0, 1024)
        if at < 0 and line.startswith(("event:", "id:", ":", "retry:", "#")):
            continue
        entry += 1
        if at < 0:
            yield entry, BrokenEntry("json", "the line holds no JSON object")
        elif len(line) > MAX_LINE:
            yield entry, BrokenEntry("long-line", f"the line has more than {MAX_LINE} characters")
        else:
            yield entry, _checked(_parse(line[at:].rstrip(",")))


def _read_concatenated(text: str) -> Iterator[Record]:
    """Documents one after the other, over several lines each; what follows a broken one is lost with it."""
    at, entry = 0, 0
    while True:
        while at < len(text) and text[at] in _SPACE:
            at += 1
        if at >= len(text):
            return
        try:
            found, at = _DECODER.raw_decode(text, at)
        except (ValueError, RecursionError) as error:
            yield entry, BrokenEntry("json", f"{_why(error)}; from character {at} on nothing is read")
            return
        yield entry, _checked(found)
        entry += 1


class _Ambiguous(dict[str, object]):
    """An object that has a key twice."""


def _parse(text: str) -> object:
    """A JSON value, or the reason why the text is none."""
    try:
        return _DECODER.decode(text)
    except (ValueError, RecursionError) as error:
        return BrokenEntry("json", _why(error))


def _checked(value: object) -> dict[str, object] | BrokenEntry:
    """An object that is neither deep nor ambiguous, or the reason why it is left out."""
    if isinstance(value, BrokenEntry):
        return value
    if not isinstance(value, dict):
        return BrokenEntry("json", "the entry is no JSON object")
    wrong = _what_is_wrong(value, _MAX_DEPTH)
    return BrokenEntry("json", wrong) if wrong else value


def _what_is_wrong(value: Any, levels: int) -> str | None:
    if levels == 0:
        return f"more than {_MAX_DEPTH} levels"
    if isinstance(value, _Ambiguous):
        return "an object has a key twice"
    for item in value.values() if isinstance(value, dict) else value:
        if isinstance(item, dict | list) and (wrong := _what_is_wrong(item, levels - 1)):
            return wrong
    return None


def _why(error: Exception) -> str:
    if isinstance(error, RecursionError):
        return f"more than {_MAX_DEPTH} levels"
    return f"not JSON: {str(error)[:120]}"


def _object_of(pairs: list[tuple[str, object]]) -> dict[str, object]:
    found = dict(pairs)
    return found if len(found) == len(pairs) else _Ambiguous(found)


_DECODER = json.JSONDecoder(object_pairs_hook=_object_of)
"""NaN and infinity become floats that are refused where a number is read."""


# === Packets from uplink events of LoRaWAN network servers, and from gateways.
#
# ChirpStack and The Things Stack write proto3 JSON: what is zero, false or empty is left out. Sources: ChirpStack's
# api/proto/integration and api/proto/gw (v4); The Things Stack's "Data Formats" and "Storage Integration" pages (v3);
# The Things Network's "MQTT Data API" (v2); Loriot's "Application API: uplink data message"; Helium Console's "JSON
# message schema"; AWS IoT Core for LoRaWAN's "Working with uplink messages"; Actility's "LRC-AS tunnel interface";
# Semtech's packet_forwarder/PROTOCOL.TXT.


_LEVELS = 5  # envelopes around an event
_ENVELOPES = ("payload", "result", "data", "message", "msg", "body", "event")
_DURATION = re.compile(r"(\d{1,12}(?:\.\d{1,9})?)s\Z", re.ASCII)
_OTHER_EVENTS = (
    "join_accept", "downlink_ack", "downlink_nack", "downlink_sent", "downlink_failed", "downlink_queued",
    "downlink_queue_invalidated", "location_solved", "service_data", "uplink_normalized",
)  # fmt: skip


class UplinkKind(StrEnum):
    """The network server, or the program of a gateway, that an event is from."""

    CHIRPSTACK = "chirpstack-v4"
    THINGS_STACK = "things-stack-v3"
    THINGS_NETWORK = "things-network-v2"
    LORIOT = "loriot"
    HELIUM = "helium"
    AWS = "aws-iot-lorawan"
    ACTILITY = "actility-thingpark"
    SEMTECH = "semtech-udp"


def open_envelope(record: Mapping[str, Any]) -> tuple[Mapping[str, object], str | None]:
    """The event inside the envelopes of brokers, dumps and storage, and the time of the outermost envelope.

    `{"topic": ..., "payload": {...} or its text}` of MQTT dumps, `{"result": {...}}` of The Things Stack's storage,
    `{"name": "as.up.data.forward", "data": {...}}` of its event streams.

    Raises
    ------
    BrokenEntry
        The text inside is no JSON, or the entry is an error message.
    """
    outer_time: str | None = None
    for _level in range(_LEVELS):
        if find_kind(record) is not None:
            break
        inner = next((record[name] for name in _ENVELOPES if _is_event(record.get(name))), None)
        if inner is None:
            break
        outer_time = outer_time or next(
            (str(record[n]) for n in ("received_at", "time", "timestamp", "tst") if record.get(n)), None
        )
        if isinstance(inner, str):
            try:
                inner = json.loads(inner)
            except (ValueError, RecursionError):
                raise BrokenEntry("json", "the text in the envelope is not JSON") from None
            if not isinstance(inner, dict):
                raise BrokenEntry("json", "the text in the envelope is no JSON object")
        record = inner
    if isinstance(record.get("error"), dict):
        raise BrokenEntry("error", f"an error in place of an event: {clean_text(record['error'].get('message'))}")
    return record, outer_time


def _is_event(value: object) -> bool:
    return isinstance(value, dict) or (isinstance(value, str) and value.lstrip()[:1] == "{")


def find_kind(record: Mapping[str, object]) -> UplinkKind | None:
    """The network server that a JSON object is from; None if it is no uplink event."""
    if "end_device_ids" in record:
        return UplinkKind.THINGS_STACK
    if (
        "deduplicationId" in record
        or isinstance(record.get("deviceInfo"), dict)
        or isinstance(record.get("rxInfo"), list)
    ):
        return UplinkKind.CHIRPSTACK
    if "devEUI" in record and "applicationID" in record:
        return UplinkKind.CHIRPSTACK
    if isinstance(record.get("metadata"), dict) and "dev_id" in record and "app_id" in record:
        return UplinkKind.THINGS_NETWORK
    if isinstance(record.get("cmd"), str) and "EUI" in record:
        return UplinkKind.LORIOT
    if isinstance(record.get("hotspots"), list):
        return UplinkKind.HELIUM
    if isinstance(record.get("WirelessMetadata"), dict):
        return UplinkKind.AWS
    if any(name.startswith("DevEUI_") and isinstance(record[name], dict) for name in islice(record, 4)):
        return UplinkKind.ACTILITY
    if "tmst" in record and "datr" in record and "data" in record:
        return UplinkKind.SEMTECH
    return None


def packet_from_uplink(entry: int, kind: UplinkKind, record: Mapping[str, object], clock: LogClock) -> ReceivedPacket:
    """One packet of an uplink event.

    Raises
    ------
    BrokenEntry
        It is another kind of event, or has no payload that can be read.
    """
    return _READERS[kind](entry, record, clock)


# --- ChirpStack v4 ------------------------------------------------------------------------------------------------


def _from_chirpstack(entry: int, record: Mapping[str, object], clock: LogClock) -> ReceivedPacket:
    if "devEUI" in record and "deviceInfo" not in record:
        raise BrokenEntry("old-version", "an event of ChirpStack v3 or older; v4 is read")
    receptions = _objects(record.get("rxInfo"))
    if not receptions and not record.get("data"):
        raise BrokenEntry("not-uplink", "a ChirpStack event that is no uplink")
    if record.get("joinServerContext"):
        raise BrokenEntry(
            "encrypted", "the payload is still encrypted: ChirpStack has no session key (joinServerContext)"
        )
    payload = _payload_of(record.get("data"), PayloadText.BASE64)
    best = _best(receptions)
    device = record.get("deviceInfo")
    times = (record.get("time"), best.get("gwTime"), best.get("nsTime"))
    received_at_s = _first_time(times, clock)
    if math.isnan(received_at_s):
        received_at_s = _gps_time(best.get("timeSinceGpsEpoch"), clock)
    return ReceivedPacket(
        entry,
        received_at_s,
        payload,
        rssi_dbm=_signal(best.get("rssi"), math.nan),
        snr_db=_signal(best.get("snr"), 0.0 if best else math.nan),  # 0 is left out
        device=clean_text(device.get("devEui")) if isinstance(device, dict) else None,
        event=clean_text(record.get("deduplicationId")),
    )


def _gps_time(value: object, clock: LogClock) -> float:
    found = _DURATION.match(value) if isinstance(value, str) else None
    return (
        LogClock(scale=TimeScale.UNIX_S, offset_s=clock.offset_s).read(utc_from_gps_s(float(found[1])))
        if found
        else math.nan
    )


# --- The Things Stack v3 ------------------------------------------------------------------------------------------


def _from_things_stack(entry: int, record: Mapping[str, object], clock: LogClock) -> ReceivedPacket:
    uplink = record.get("uplink_message")
    if not isinstance(uplink, dict):
        other = next((name for name in _OTHER_EVENTS if name in record), "of no known kind")
        raise BrokenEntry("not-uplink", f"an event of The Things Stack that is no uplink: {other}")
    if record.get("simulated"):
        raise BrokenEntry("simulated", "a simulated uplink: nothing was received")
    payload = _payload_of(uplink.get("frm_payload"), PayloadText.BASE64)
    best = _best(_objects(uplink.get("rx_metadata")), "rssi", "channel_rssi")
    settings = uplink.get("settings")
    times = (
        uplink.get("received_at"),
        record.get("received_at"),
        best.get("time"),
        settings.get("time") if isinstance(settings, dict) else None,
    )
    ids = record["end_device_ids"] if isinstance(record["end_device_ids"], dict) else {}
    eui = clean_text(ids.get("dev_eui"))
    session = clean_text(uplink.get("session_key_id"))
    count = uplink.get("f_cnt", 0)
    return ReceivedPacket(
        entry,
        _first_time(times, clock),
        payload,
        rssi_dbm=_signal(best.get("rssi"), _signal(best.get("channel_rssi"), math.nan)),
        snr_db=_signal(best.get("snr"), 0.0 if best else math.nan),
        device=eui or clean_text(ids.get("device_id")),
        event=f"{eui}/{session}/{clean_text(count)}" if eui and session else None,
    )


# --- others -------------------------------------------------------------------------------------------------------


def _from_things_network(entry: int, record: Mapping[str, object], clock: LogClock) -> ReceivedPacket:
    metadata = _mapping(record.get("metadata"))
    best = _best(_objects(metadata.get("gateways")))
    return ReceivedPacket(
        entry,
        _first_time((metadata.get("time"), best.get("time")), clock),
        _payload_of(record.get("payload_raw"), PayloadText.BASE64),
        rssi_dbm=_signal(best.get("rssi"), math.nan),
        snr_db=_signal(best.get("snr"), math.nan),
        device=clean_text(record.get("hardware_serial")) or clean_text(record.get("dev_id")),
    )


def _from_loriot(entry: int, record: Mapping[str, object], clock: LogClock) -> ReceivedPacket:
    if record["cmd"] not in ("rx", "gw"):
        raise BrokenEntry("not-uplink", f"a message of Loriot that is no uplink: {clean_text(record['cmd'], 40)}")
    if not record.get("data") and record.get("encdata"):
        raise BrokenEntry("encrypted", "the payload is still encrypted: Loriot has no application key (encdata)")
    best = _best(_objects(record.get("gws"))) or record
    device, count = clean_text(record.get("EUI")), clean_text(record.get("fcnt"))
    return ReceivedPacket(
        entry,
        _unix_time(record.get("ts"), clock),
        _payload_of(record.get("data"), PayloadText.HEX),
        rssi_dbm=_signal(best.get("rssi"), math.nan),
        snr_db=_signal(best.get("snr"), math.nan),
        device=device,
        # the same uplink comes as rx, and as gw with its gateways
        event=f"{device}/{count}/{clean_text(record.get('ts'))}",
    )


def _from_helium(entry: int, record: Mapping[str, object], clock: LogClock) -> ReceivedPacket:
    if record.get("type", "uplink") != "uplink":
        raise BrokenEntry("not-uplink", f"an event of Helium that is no uplink: {clean_text(record['type'], 40)}")
    best = _best(_objects(record.get("hotspots")))
    return ReceivedPacket(
        entry,
        _unix_time(record.get("reported_at", best.get("reported_at")), clock),
        _payload_of(record.get("payload"), PayloadText.BASE64),
        rssi_dbm=_signal(best.get("rssi"), math.nan),
        snr_db=_signal(best.get("snr"), math.nan),
        device=clean_text(record.get("dev_eui")),
        event=clean_text(record.get("uuid")),
    )


def _from_aws(entry: int, record: Mapping[str, object], clock: LogClock) -> ReceivedPacket:
    lorawan = _mapping(_mapping(record["WirelessMetadata"]).get("LoRaWAN"))
    if not lorawan:
        raise BrokenEntry("not-uplink", "an event of AWS IoT Wireless that is no uplink of LoRaWAN")
    best = _best(_objects(lorawan.get("Gateways")), "Rssi")
    return ReceivedPacket(
        entry,
        _first_time((lorawan.get("Timestamp"),), clock),
        _payload_of(record.get("PayloadData"), PayloadText.BASE64),
        rssi_dbm=_signal(best.get("Rssi"), math.nan),
        snr_db=_signal(best.get("Snr"), math.nan),
        device=clean_text(lorawan.get("DevEui")),
    )


def _from_actility(entry: int, record: Mapping[str, object], clock: LogClock) -> ReceivedPacket:
    uplink = _mapping(record.get("DevEUI_uplink"))
    if not uplink:
        other = clean_text(next(name for name in record if name.startswith("DevEUI_")), 40)
        raise BrokenEntry("not-uplink", f"a report of Actility ThingPark that is no uplink: {other}")
    if str(uplink.get("payload_encryption", 0)) == "1":
        raise BrokenEntry("encrypted", "the payload is still encrypted: ThingPark has no key (payload_encryption)")
    return ReceivedPacket(
        entry,
        _first_time((uplink.get("Time"),), clock),
        _payload_of(uplink.get("payload_hex"), PayloadText.HEX),
        rssi_dbm=_signal(uplink.get("LrrRSSI"), math.nan),  # of the gateway that received it best
        snr_db=_signal(uplink.get("LrrSNR"), math.nan),
        device=clean_text(uplink.get("DevEUI")),
    )


def _from_semtech(entry: int, record: Mapping[str, object], clock: LogClock) -> ReceivedPacket:
    if record.get("stat") == -1:
        raise BrokenEntry("crc", "the gateway received the packet with a wrong checksum (stat -1)")
    payload = _payload_of(record.get("data"), PayloadText.BASE64)
    if payload[0] >> 5 in _LORAWAN_UPLINKS and payload[0] & 0x1F == 0 and len(payload) >= _LORAWAN_BYTES:
        raise BrokenEntry(
            "encrypted", "a LoRaWAN frame as the gateway received it: log the uplinks of the network server instead"
        )
    received_at_s = _first_time((record.get("time"),), clock)
    gps_ms = record.get("tmms")
    if math.isnan(received_at_s) and isinstance(gps_ms, int):
        received_at_s = LogClock(scale=TimeScale.GPS_MS, offset_s=clock.offset_s).read(gps_ms)
    return ReceivedPacket(
        entry,
        received_at_s,
        payload,
        rssi_dbm=_signal(record.get("rssi"), math.nan),
        snr_db=_signal(record.get("lsnr"), math.nan),
    )


_LORAWAN_UPLINKS = (0, 2, 4)  # message types: join request, unconfirmed and confirmed data (LoRaWAN 1.0.4, 4.2.1)
_LORAWAN_BYTES = 12  # [byte] shortest data frame
_READERS = {
    UplinkKind.CHIRPSTACK: _from_chirpstack,
    UplinkKind.THINGS_STACK: _from_things_stack,
    UplinkKind.THINGS_NETWORK: _from_things_network,
    UplinkKind.LORIOT: _from_loriot,
    UplinkKind.HELIUM: _from_helium,
    UplinkKind.AWS: _from_aws,
    UplinkKind.ACTILITY: _from_actility,
    UplinkKind.SEMTECH: _from_semtech,
}


# --- all ---------------------------------------------------------------------------------------------------------


def _mapping(value: object) -> dict[str, object]:
    return value if isinstance(value, dict) else {}


def _payload_of(value: object, written: PayloadText) -> bytes:
    payload = read_payload(value, written)
    if not payload:
        raise BrokenEntry("no-payload", "an uplink without a payload")
    return payload


def _unix_time(value: object, clock: LogClock) -> float:
    return LogClock(offset_s=clock.offset_s).read(value)


def _objects(value: object) -> list[dict[str, object]]:
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def _best(receptions: list[dict[str, object]], rssi: str = "rssi", other_rssi: str = "") -> dict[str, object]:
    """The reception of the strongest gateway; an RSSI of zero, which is left out, was not measured."""
    return max(
        receptions,
        key=lambda reception: _signal(reception.get(rssi), _signal(reception.get(other_rssi), -math.inf)),
        default={},
    )


def _first_time(values: tuple[object, ...], clock: LogClock) -> float:
    for value in values:
        if isinstance(value, str):
            at = clock.read(value)
            if not math.isnan(at):
                return at
    return math.nan


def _signal(value: object, missing: float) -> float:
    """An RSSI or SNR, also as text; those that no receiver measures are missing."""
    if isinstance(value, str):
        try:
            value = read_number(value)
        except ValueError:
            return missing
    if isinstance(value, bool) or not isinstance(value, int | float) or not -200 <= value <= 60:
        return missing
    return float(value)


# === Packet logs as JSON: objects with named values, or uplink events of LoRaWAN network servers.


_MAX_SHAPES = 100  # sets of names whose columns are remembered
_Shapes = dict[tuple[str, ...], dict[str, int]]


def read_json(source: PacketSource) -> Iterator[ReceivedPacket]:
    """Packets of the entries; an entry that cannot be read is left out.

    Raises
    ------
    UploadTooLarge
        One document has more characters than the limit.
    """
    sample, report = source.sample, source.report
    shapes: _Shapes = {}
    records = _each_packet(read_records(sample.name, sample.text, source.limits.document_bytes))
    for entry, record in records:
        report.entries += 1
        try:
            if isinstance(record, BrokenEntry):
                raise record
            yield _packet_from_record(entry, record, source, shapes)
        except BrokenEntry as broken:
            report.leave_out(entry, broken.kind, broken.reason)


def _each_packet(records: Iterator[Record]) -> Iterator[Record]:
    """Records; each packet of a datagram of Semtech's gateways, which holds several, is one of its own."""
    more = 0
    for entry, record in records:
        packets = _datagram_of(record) if isinstance(record, dict) else None
        if packets is None:
            yield entry + more, record
            continue
        for packet in packets:
            yield entry + more, _checked(packet)
            more += 1
        more -= 1


def _datagram_of(record: dict[str, object]) -> list[object] | None:
    """The packets of a datagram, also in an envelope; None if it is none."""
    if "rxpk" not in record and find_kind(record) is None:
        inner = next((record[name] for name in _ENVELOPES if _is_event(record.get(name))), None)
        if isinstance(inner, str) and '"rxpk"' in inner:
            inner = _parse(inner)
        record = inner if isinstance(inner, dict) else record
    packets = record.get("rxpk")
    return packets if isinstance(packets, list) else None


def _packet_from_record(
    entry: int, record: Mapping[str, object], source: PacketSource, shapes: _Shapes
) -> ReceivedPacket:
    declaration = source.declaration
    event, outer_time = open_envelope(record)
    kind = find_kind(event)
    if kind is not None:
        source.report.format = str(kind)
        return packet_from_uplink(entry, kind, event, declaration.times)
    names = tuple(event)[:256]
    places = match_columns(names, ALIASES, declaration.columns or {}) if names not in shapes else shapes[names]
    if len(shapes) < _MAX_SHAPES:
        shapes[names] = places
    if "payload" not in places and not all(quantity in places for quantity in NEEDED):
        raise BrokenEntry(
            "unknown", "neither an uplink nor an object with a payload, or with id, latitude and longitude"
        )
    values = {quantity: event[names[place]] for quantity, place in places.items()}
    values.setdefault("time", outer_time)
    written = payload_text(names[places["payload"]] if "payload" in places else "", declaration)
    packet = packet_from_values(entry, values, declaration.times, written)
    source.report.note_unread_time(values.get("time"), packet.received_at_s)
    source.report.note_zone(values.get("time"), declaration.times)
    return packet


def looks_like_json_dump(text: str) -> bool:
    """Whether lines hold a word or two and then a JSON object: what mosquitto_sub -v and event streams write."""
    lines = [line for _number, line in islice(numbered_lines(text[: 1 << 16]), 20)]
    found = sum(1 for line in lines if re.match(r"[^{},;\"]{1,512}[\s:]\{\s*\"", line[:1024]))
    return 2 * found > len(lines) or (found > 0 and lines[0].startswith(("data:", "event:", "id:", ":")))
